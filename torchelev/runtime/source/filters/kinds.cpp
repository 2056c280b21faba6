// The filters that the library has, by name, with the settings and errors of Python.

#include "runtime/source/filters/kinds.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "tables.h"

namespace {

typedef const std::vector<const Cells*>& From;
typedef FilterChain::Run Run;

const char* const ENTRY_KEYS[] = {"layer", "filter", "inputs"};

// A setting of an entry.
class Value {
    const Json* given;
    const std::string name;  // that errors call it
    double usual;

  public:
    Value(const Json& entry, const std::string& where, const char* filter, const char* setting)
        : given(entry.find(setting)), name(where + setting) {
        for (const FilterSetting& s : FILTER_SETTINGS)
            if (!std::strcmp(s.filter, filter) && !std::strcmp(s.name, setting)) usual = s.usual;
    }

    double positive() const {
        if (!given) return usual;
        REQUIRE(given->kind == Json::NUMBER && std::isfinite(given->number) && given->number > 0, name,
                "must be a positive number", given->describe(), "give metres");
        return given->number;
    }

    // A window's radius in cells, which reaches so many times as far as the setting: `radius_cells`.
    int64_t radius(double resolution, double reach = 1) const {
        const double length = positive(), cells = reach * length / resolution;
        REQUIRE(cells <= MAX_RADIUS, name,
                "must be at most " + general(MAX_RADIUS * resolution / reach) + " m, a window of " +
                    std::to_string(MAX_RADIUS) + " cells",
                given->describe(), "give a smaller one");
        return std::max<int64_t>(1, int64_t(std::nearbyint(cells)));
    }

    // A number of steps; none where null is the default and given, or the default.
    std::optional<int64_t> count(const char* hint) const {
        const bool is_null = given ? given->kind == Json::NUL : std::isnan(usual);
        if (is_null && std::isnan(usual)) return {};
        if (!given) return int64_t(usual);
        const bool fits = given->kind == Json::NUMBER && given->is_whole && given->number >= 1 && given->number < 1e15;
        REQUIRE(fits, name, "must be a positive int", given->describe(), hint);
        return int64_t(given->number);
    }
};

Run make_box(const Json& entry, const std::string& where, const FilterGrid& grid) {
    const std::vector<double> weights(1 + Value(entry, where, "box", "radius").radius(grid.resolution), 1.0);
    return [=](From from, Cells& to) { filters::mean(grid, *from[0], weights, to); };
}

Run make_gaussian(const Json& entry, const std::string& where, const FilterGrid& grid) {
    const Value given(entry, where, "gaussian", "sigma");
    const int64_t radius = given.radius(grid.resolution, 3);
    const double sigma = given.positive() / grid.resolution;
    std::vector<double> weights(1, 1.0);
    for (int64_t k = 1; k <= radius; k++) weights.push_back(std::exp(-0.5 * (double(k) / sigma) * (double(k) / sigma)));
    return [=](From from, Cells& to) { filters::mean(grid, *from[0], weights, to); };
}

Run make_median(const Json& entry, const std::string& where, const FilterGrid& grid) {
    const int64_t radius = Value(entry, where, "median", "radius").radius(grid.resolution);
    return [=](From from, Cells& to) { filters::median(grid, *from[0], radius, to); };
}

Run make_minimum(const Json& entry, const std::string& where, const FilterGrid& grid) {
    const auto turns =
        Value(entry, where, "inpaint_minimum", "iterations").count("give None for holes of any size");
    return [=](From from, Cells& to) { filters::inpaint_minimum(grid, *from[0], turns, to); };
}

Run make_diffusion(const Json& entry, const std::string& where, const FilterGrid& grid) {
    const double tolerance = Value(entry, where, "inpaint_diffusion", "tolerance").positive();
    const int64_t turns = *Value(entry, where, "inpaint_diffusion", "iterations").count("give 40");
    return [=](From from, Cells& to) { filters::inpaint_diffusion(grid, *from[0], tolerance, turns, to); };
}

Run make_nearest(const Json&, const std::string&, const FilterGrid& grid) {
    return [=](From from, Cells& to) { filters::inpaint_nearest(grid, *from[0], to); };
}

Run make_fill_from(const Json&, const std::string&, const FilterGrid&) {
    return [](From from, Cells& to) { filters::fill_from(*from[0], *from[1], to); };
}

constexpr FilterKind KINDS[] = {{"box", 1, make_box},
                                {"fill_from", 2, make_fill_from},
                                {"gaussian", 1, make_gaussian},
                                {"inpaint_diffusion", 1, make_diffusion},
                                {"inpaint_minimum", 1, make_minimum},
                                {"inpaint_nearest", 1, make_nearest},
                                {"median", 1, make_median}};

}  // namespace

const FilterKind& filter_kind(const std::string& name, const std::string& where) {
    std::vector<std::string> names;
    for (const FilterKind& kind : KINDS) {
        if (name == kind.name) return kind;
        names.push_back(kind.name);
    }
    const bool is_in_python = std::find(std::begin(ALL_FILTERS), std::end(ALL_FILTERS), name) != std::end(ALL_FILTERS);
    REQUIRE(is_in_python, where + "filter", "must be a filter's name", "'" + name + "'",
            "there are " + joined(ALL_FILTERS));
    refuse(where + "filter", "needs Python: this library has " + joined(names), "'" + name + "'",
           "leave it out, or run the map in Python", TORCHELEV_UNSUPPORTED);
}

void require_settings(const Json& entry, const std::string& filter, const std::string& where) {
    std::vector<std::string> names, others;
    for (const FilterSetting& setting : FILTER_SETTINGS)
        if (filter == setting.filter) names.push_back(setting.name);
    for (const auto& [key, value] : entry.members) {
        const bool is_known = std::find(names.begin(), names.end(), key) != names.end();
        const bool is_of_entry = std::find(std::begin(ENTRY_KEYS), std::end(ENTRY_KEYS), key) != std::end(ENTRY_KEYS);
        if (!is_known && !is_of_entry) others.push_back(key);
    }
    std::sort(others.begin(), others.end());
    REQUIRE(others.empty(), where + "filter " + filter, "must be given settings that it has", joined(others),
            "it takes " + (names.empty() ? "none" : joined(names)));
}
