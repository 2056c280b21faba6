// The filters of a config, in their order: filters/chain.py and registry.py.

#include "runtime/source/filters/chain.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <optional>

#include "tables.h"

namespace {

const std::vector<std::string> FILTERS = {"box",
                                          "fill_from",
                                          "gaussian",
                                          "inpaint_diffusion",
                                          "inpaint_minimum",
                                          "inpaint_nearest",
                                          "median"};
const std::vector<std::string> ENTRY_KEYS = {"layer", "filter", "inputs"};
typedef std::function<void(const std::vector<const Cells*>&, Cells&)> Run;

template <class Values>
bool holds(const Values& values, const std::string& name) {
    return std::find(values.begin(), values.end(), name) != values.end();
}

bool is_identifier(const std::string& name) {
    auto is_letter = [](char c) { return std::isalpha(static_cast<unsigned char>(c)) || c == '_'; };
    auto fits = [&](char c) { return is_letter(c) || std::isdigit(static_cast<unsigned char>(c)); };
    return !name.empty() && is_letter(name[0]) && std::all_of(name.begin(), name.end(), fits);
}

// An entry's settings.
class Settings {
    const Json& entry;
    const std::string where;  // "filters.<layer>: "

  public:
    Settings(const Json& entry, const std::string& where, const std::string& filter,
             const std::vector<std::string>& names)
        : entry(entry), where(where) {
        std::vector<std::string> others;
        for (const auto& [key, value] : entry.members)
            if (!holds(ENTRY_KEYS, key) && !holds(names, key)) others.push_back(key);
        std::sort(others.begin(), others.end());
        REQUIRE(others.empty(), where + "filter " + filter, "must be given settings that it has", joined(others),
                "it takes " + (names.empty() ? "none" : joined(names)));
    }

    double positive(const char* name, double usual) const {
        const Json* value = entry.find(name);
        if (!value) return usual;
        REQUIRE(value->kind == Json::NUMBER && std::isfinite(value->number) && value->number > 0, where + name,
                "must be a positive number", value->describe(), "give metres");
        return value->number;
    }

    // A window's radius in cells: `radius_cells`.
    int64_t radius(const char* name, double usual, double factor, double resolution) const {
        const double length = factor * positive(name, usual), cells = length / resolution;
        REQUIRE(cells <= MAX_RADIUS, where + "radius",
                "must be at most " + std::to_string(MAX_RADIUS) + " cells of " + general(resolution) + " m",
                repr(length), "give metres");
        return std::max<int64_t>(1, int64_t(std::nearbyint(cells)));
    }

    std::optional<int64_t> count(const char* name, std::optional<int64_t> usual, const char* hint) const {
        const Json* value = entry.find(name);
        if (!value) return usual;
        if (value->kind == Json::NUL && !usual) return usual;
        const bool fits = value->kind == Json::NUMBER && value->is_whole && value->number >= 1 && value->number < 1e15;
        REQUIRE(fits, where + name, "must be a positive int", value->describe(), hint);
        return int64_t(value->number);
    }
};

// Return what a filter does.
Run make_run(const Json& entry, const std::string& filter, const std::string& where, const Plane2D& grid) {
    auto settings = [&](const std::vector<std::string>& names) { return Settings(entry, where, filter, names); };
    typedef const std::vector<const Cells*>& From;
    if (filter == "gaussian") {
        const Settings given = settings({"sigma"});
        const double sigma = given.positive("sigma", 0.1) / grid.resolution;
        std::vector<double> weights;
        for (int64_t k = 0; k <= given.radius("sigma", 0.1, 3, grid.resolution); k++)
            weights.push_back(std::exp(-0.5 * double(k * k) / (sigma * sigma)));
        return [grid, weights](From from, Cells& to) { filters::mean(grid, *from[0], weights, to); };
    }
    if (filter == "box") {
        const std::vector<double> weights(1 + settings({"radius"}).radius("radius", 0.1, 1, grid.resolution), 1.0);
        return [grid, weights](From from, Cells& to) { filters::mean(grid, *from[0], weights, to); };
    }
    if (filter == "median") {
        const int64_t radius = settings({"radius"}).radius("radius", 0.05, 1, grid.resolution);
        return [grid, radius](From from, Cells& to) { filters::median(grid, *from[0], radius, to); };
    }
    if (filter == "inpaint_minimum") {
        const auto turns = settings({"iterations"}).count("iterations", {}, "give None for holes of any size");
        return [grid, turns](From from, Cells& to) { filters::inpaint_minimum(grid, *from[0], turns, to); };
    }
    if (filter == "inpaint_diffusion") {
        const Settings given = settings({"tolerance", "iterations"});
        const double tolerance = given.positive("tolerance", 1e-3);
        const int64_t turns = *given.count("iterations", 40, "give 40");
        return [=](From from, Cells& to) { filters::inpaint_diffusion(grid, *from[0], tolerance, turns, to); };
    }
    settings({});
    if (filter == "inpaint_nearest")
        return [grid](From from, Cells& to) { filters::inpaint_nearest(grid, *from[0], to); };
    return [](From from, Cells& to) { filters::fill_from(*from[0], *from[1], to); };
}

std::vector<std::string> inputs_of(const Json& entry, const std::string& where) {
    const Json* inputs = entry.find("inputs");
    std::vector<std::string> names;
    if (inputs && inputs->kind == Json::STRING) names.push_back(inputs->text);
    const bool is_list = inputs && inputs->kind == Json::ARRAY;
    REQUIRE(!inputs || is_list || inputs->kind == Json::STRING, where + "inputs", "must be names of layers",
            inputs->describe(), "give a list of names");
    for (size_t k = 0; is_list && k < inputs->items.size(); k++) names.push_back(inputs->items[k].text);
    return names.empty() ? std::vector<std::string>{"elevation"} : names;
}

}  // namespace

FilterChain::FilterChain(const std::vector<Json>& list, const Plane2D& grid, const std::vector<std::string>& layers)
    : grid(grid) {
    for (size_t k = 0; k < list.size(); k++) add(list[k], k, layers);
}

void FilterChain::add(const Json& entry, size_t number, const std::vector<std::string>& layers) {
    const Json *layer = entry.find("layer"), *filter = entry.find("filter");
    const bool is_named = layer && filter && layer->kind == Json::STRING && filter->kind == Json::STRING;
    REQUIRE(is_named, "config.filters[" + std::to_string(number) + "]", "must name its layer and its filter",
            entry.describe(), "write one as {layer: smooth, filter: gaussian, sigma: 0.1}");
    const std::string name = layer->text, where = "filters." + name;
    std::vector<std::string> available = layers;
    for (const Step& step : steps) available.push_back(step.layer);
    REQUIRE(is_identifier(name) && !holds(available, name), where, "must be a name of its own, of letters and digits",
            "'" + name + "'", "rename it");
    const std::vector<std::string> inputs = inputs_of(entry, where + ".");
    std::vector<std::string> missing;
    for (const std::string& input : inputs)
        if (!holds(available, input)) missing.push_back(input);
    REQUIRE(missing.empty(), where, "must read layers that are made before it", joined(missing),
            "there are " + joined(available));
    REQUIRE(holds(FILTERS, filter->text), where + ": filter", "needs Python: this library has " + joined(FILTERS),
            "'" + filter->text + "'", "leave it out, or run the map in Python", TORCHELEV_UNSUPPORTED);
    Run run = make_run(entry, filter->text, where + ": ", grid);
    const size_t takes = filter->text == "fill_from" ? 2 : 1;
    REQUIRE(inputs.size() == takes, where + ": filter " + filter->text, "takes " + std::to_string(takes) + " layers",
            std::to_string(inputs.size()) + " inputs", "name as many inputs");
    const size_t cells = size_t(grid.cells());
    Cells made{std::vector<float>(cells), std::vector<uint8_t>(cells)};
    steps.push_back({name, inputs, std::move(run), std::move(made), false});
}

bool FilterChain::has(const std::string& layer) const { return holds(names(), layer); }

std::vector<std::string> FilterChain::names() const {
    std::vector<std::string> found;
    for (const Step& step : steps) found.push_back(step.layer);
    return found;
}

void FilterChain::forget() {
    for (Step& step : steps) step.is_made = false;
}

const Cells& FilterChain::read(const std::string& layer,
                               const std::function<void(const std::string&, Cells&)>& given) {
    auto step = std::find_if(steps.begin(), steps.end(), [&](const Step& s) { return s.layer == layer; });
    if (step->is_made) return step->made;
    std::vector<Cells> of_map(step->inputs.size(), step->made);
    std::vector<const Cells*> from;
    for (size_t k = 0; k < step->inputs.size(); k++) {
        const std::string& input = step->inputs[k];
        if (!has(input)) given(input, of_map[k]);
        from.push_back(has(input) ? &read(input, given) : &of_map[k]);
    }
    step->run(from, step->made);
    step->is_made = true;
    return step->made;
}
