// The rules of settings: those of config.py and of the stages' config.py.
#include <algorithm>
#include <cmath>

#include "runtime/source/config.h"

#include "tables.h"

void Config::require_rule(bool holds, const std::string& name, const std::string& rule, const std::string& hint) const {
    const size_t k = find(name);
    const double value = entries[k].values[0];
    REQUIRE(holds, name, rule, SETTINGS[k].kind == INTEGER ? general(value, 10) : repr(value), hint);
}

void Config::require_at_least(const std::string& name, double least, const std::string& rule,
                              const std::string& hint) const {
    require_rule((*this)[name] >= least, name, rule, hint);
}

void Config::check() const {
    check_grid(), check_sensor(), check_drift(), check_fusion(), check_rays(), check_surface(), check_levels();
}

void Config::check_grid() const {
    const Config& cfg = *this;
    for (const char* name : {"grid.resolution", "grid.length_x", "grid.length_y"})
        require_rule(cfg[name] > 0 && std::isfinite(cfg[name]), name, "must be a positive number", "give metres");
    const double size = cfg["grid.resolution"];
    for (const char* name : {"grid.length_x", "grid.length_y"}) {
        const double cells = cfg[name] / size, whole = std::nearbyint(cells);
        const bool is_whole = std::isfinite(cells) && whole >= 1 && std::fabs(cells - whole) < 1e-6 * cells;
        const std::string hint = std::isfinite(cells) ? "try " + general(std::max(1.0, whole) * size) : "give metres";
        REQUIRE(is_whole, name, "must be a whole number of times " + general(size) + " m", general(cells) + " times",
                hint);
    }
    REQUIRE(size >= MIN_RESOLUTION, "grid.resolution", "must be at least " + repr(MIN_RESOLUTION) + " m", repr(size),
            "give metres");
    const double number = std::nearbyint(cfg["grid.length_x"] / size) * std::nearbyint(cfg["grid.length_y"] / size);
    REQUIRE(number <= 67108864.0, "grid", "must have at most 2^26 cells", general(number), "use larger cells");
}

void Config::check_sensor() const {
    const Config& cfg = *this;
    const char* not_negative = "must not be negative";
    require_at_least("sensor.noise_factor", 0, not_negative, "give 1e-4");
    require_rule(cfg["sensor.noise_floor"] > 0, "sensor.noise_floor", "must be positive", "give 2.5e-5 m^2");
    const double nearest = cfg["sensor.min_distance"], farthest = cfg["sensor.max_distance"];
    REQUIRE(0 <= nearest && nearest < farthest, "sensor.min_distance, max_distance", "must be ordered",
            "(" + repr(nearest) + ", " + repr(farthest) + ")", "give 0 <= min < max in metres");
    require_at_least("aging.variance_rate", 0, not_negative, "give m^2/s");
}

void Config::check_drift() const {
    const Config& cfg = *this;
    if (!has("drift")) return;
    require_rule(0 < cfg["drift.gain"] && cfg["drift.gain"] <= 1, "drift.gain", "must lie in (0, 1]",
                 "the paper's value is 1");
    const double gate = cfg["drift.min_traversability"];
    require_rule(!has("drift.min_traversability") || (0 <= gate && gate <= 1), "drift.min_traversability",
                 "must lie in [0, 1] or be None", "leave it out for the head's own");
    require_at_least("drift.min_points", 1, "must be at least 1", "give 50");
}

void Config::check_fusion() const {
    const Config& cfg = *this;
    if (has("fusion.edges")) {
        const std::pair<const char*, int> least[] = {{"min_points", 2}, {"min_extreme", 1}, {"refinements", 2}};
        for (const auto& [name, value] : least) {
            const std::string several = "must be an int of at least " + std::to_string(value);
            require_at_least(std::string("fusion.edges.") + name, value, value > 1 ? several : "must be a positive int",
                             "see its default");
        }
        require_rule(cfg["fusion.edges.refinements"] <= MAX_REFINEMENTS, "fusion.edges.refinements",
                     "must be at most " + std::to_string(MAX_REFINEMENTS), "see its default");
        require_at_least("fusion.edges.margin", 0, "must not be negative", "give 0.25");
        require_rule(cfg["fusion.edges.min_share"] > 0, "fusion.edges.min_share", "must be positive", "give 0.25");
    }
    for (const char* name : {"fusion.gate", "fusion.max_gate_std", "fusion.scan_variance_floor", "fusion.max_variance"})
        require_rule(cfg[name] > 0, name, "must be positive", "see its default");
    for (const char* name : {"fusion.relief", "fusion.max_support"})
        require_rule(0 <= cfg[name] && std::isfinite(cfg[name]), name, "must be finite and not negative",
                     "see its default");
    for (const char* name : {"fusion.min_above", "fusion.max_above_per_scan"}) {
        require_at_least(name, 1, "must be a positive int", "see its default");
        require_rule(cfg[name] <= 255, name, "must be at most 255 points", "see its default");
    }
    for (const char* name : {"fusion.scan_variance_floor", "fusion.max_variance"})
        require_rule(std::isfinite(cfg[name]), name, "must be finite", "give a large number such as 1e6");
}

void Config::check_rays() const {
    const Config& cfg = *this;
    if (has("raycast")) {
        require_at_least("raycast.min_time", 0, "must not be negative", "give seconds");
        require_rule(0 <= cfg["raycast.min_incidence"] && cfg["raycast.min_incidence"] < 1, "raycast.min_incidence",
                     "must lie in [0, 1)", "give a cosine such as 0.1");
        require_rule(cfg["raycast.gate"] > 0, "raycast.gate", "must be positive",
                     "give standard deviations, such as 3");
        const double reach = cfg["raycast.max_range"];
        require_rule(!has("raycast.max_range") || (reach > 0 && std::isfinite(reach)), "raycast.max_range",
                     "must be positive and finite", "give metres, or None");
        require_rule(0 <= cfg["raycast.min_support"] && std::isfinite(cfg["raycast.min_support"]),
                     "raycast.min_support", "must be finite and not negative", "give points");
    }
    if (has("overlap")) {
        for (const char* name : {"overlap.radius", "overlap.height"})
            require_rule(cfg[name] > 0, name, "must be positive", "give metres, or overlap=None");
        require_at_least("overlap.base_height", 0, "must not be negative", "give metres; a legged robot's is 0.5");
        require_at_least("overlap.max_base_height", cfg["overlap.base_height"], "must be at least overlap.base_height",
                         "give the highest base of your robots [m]");
    }
}

void Config::check_levels() const {
    const Config& cfg = *this;
    if (!has("levels")) return;
    require_rule(1 <= cfg["levels.max_levels"] && cfg["levels.max_levels"] <= MAX_LEVELS, "levels.max_levels",
                 "must be a whole number from 1 to " + std::to_string(MAX_LEVELS),
                 "3 hold ground, table and ceiling; each more costs time and 20 bytes a cell");
    for (const char* name : {"levels.min_gap", "levels.max_step"}) {
        require_rule(cfg[name] > 0 && std::isfinite(cfg[name]), name, "must be a positive number", "give metres");
        require_rule(cfg[name] <= MAX_HEIGHT, name, "must be at most " + general(MAX_HEIGHT) + " m", "give metres");
    }
    for (const char* name : {"levels.max_blind", "levels.min_support"})
        require_rule(0 <= cfg[name] && std::isfinite(cfg[name]), name, "must be finite and not negative",
                     "leave it out for the default");
}

void Config::check_surface() const {
    const Config& cfg = *this;
    require_at_least("surface.radius", 1, "must be at least 1 cell", "give 1");
    require_rule(cfg["surface.radius"] <= MAX_RADIUS, "surface.radius",
                 "must be at most " + std::to_string(MAX_RADIUS) + " cells", "give 1");
    if (!has("traversability")) return;
    const double radius = cfg["traversability.radius"], slope = cfg["traversability.critical_slope"];
    require_rule(radius > 0 && std::isfinite(radius), "traversability.radius", "must be positive and finite",
                 "give 0.1");
    for (const char* name : {"critical_slope", "critical_step", "critical_roughness"}) {
        const std::string full = std::string("traversability.") + name;
        require_rule(cfg[full] > 0, full, "must be positive", "give inf to switch it off");
    }
    require_rule(slope < std::acos(-1.0) / 2 || std::isinf(slope), "traversability.critical_slope",
                 "must be below pi / 2", "give radians, such as 0.7, or inf to switch it off");
    require_rule(
        radius / cfg["grid.resolution"] <= MAX_RADIUS, "traversability.radius",
        "must be at most " + std::to_string(MAX_RADIUS) + " cells of " + general(cfg["grid.resolution"]) + " m",
        "give 0.1");
}
