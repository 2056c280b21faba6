// Reading settings, and their rules: those of config.py and of the stages' config.py.
#include "runtime/source/config.h"

#include "tables.h"

namespace {

constexpr size_t NUMBER_OF_SETTINGS = std::size(SETTINGS);
const char *const VERSION_NAME = "torchelev_config", *const SCHEMA_NAME = "$schema";

std::string last_part(const std::string& name) { return name.substr(name.rfind('.') + 1); }

std::string group_of(const std::string& name) {
    const size_t dot = name.rfind('.');
    return dot == std::string::npos ? "" : name.substr(0, dot);
}

// The names of the settings of a group, the root's for "".
std::string names_in(const std::string& group) {
    std::vector<std::string> names;
    for (const Setting& setting : SETTINGS)
        if (group_of(setting.name) == group) names.push_back(last_part(setting.name));
    return joined(names);
}

// Whether a saved map depends on a setting of this kind. On filters it does not: they only read it.
bool is_of_state(Kind kind) { return kind < ONLY_PYTHON; }

// The words of a setting that is one of several.
std::vector<std::string> words_of(const std::string& name) {
    std::vector<std::string> words;
    for (const Choice& choice : CHOICES)
        if (last_part(name) == choice.setting) words.push_back(choice.word);
    return words;
}

void require_known_version(const Json& root, const std::string& where) {
    const Json* version = root.find(VERSION_NAME);
    const bool is_known = !version || (version->is_whole && version->number == CONFIG_VERSION);
    REQUIRE(is_known, where + ", " + VERSION_NAME, "must be " + std::to_string(CONFIG_VERSION),
            version ? version->describe() : "none", "read it with a newer torchelev", TORCHELEV_BAD_FILE);
}

}  // namespace

size_t Config::find(const std::string& name) {
    for (size_t k = 0; k < NUMBER_OF_SETTINGS; k++)
        if (name == SETTINGS[k].name) return k;
    return NUMBER_OF_SETTINGS;
}

Config::Config(const std::string& text, const std::string& where) {
    for (const Setting& s : SETTINGS) entries.push_back({s.is_null, {s.values[0], s.values[1], s.values[2]}});
    Json root = JsonReader::read(text, where);
    REQUIRE(root.kind == Json::OBJECT, "config", "must be a mapping", root.type(), "see ElevationMapConfig");
    require_known_version(root, where);
    read_group(root, "");
    check();
}

void Config::read_group(const Json& group, const std::string& prefix) {
    for (const auto& [name, value] : group.members) {
        if (prefix.empty() && (name == VERSION_NAME || name == SCHEMA_NAME)) continue;
        if (prefix.empty() && name == "completion" && value.kind == Json::NUL) continue;  // of old files
        const size_t k = find(prefix + name);
        const std::string parent = prefix.empty() ? "" : prefix.substr(0, prefix.size() - 1);
        REQUIRE(k < NUMBER_OF_SETTINGS, "config." + prefix + name, "is not a setting", "'" + name + "'",
                "there are " + names_in(parent));
        read_setting(k, value);
    }
}

void Config::read_setting(size_t k, const Json& value) {
    const Setting& setting = SETTINGS[k];
    const std::string where = std::string("config.") + setting.name;
    if (setting.kind == IGNORED) {
        const bool is_group = value.kind == Json::NUL || value.kind == Json::OBJECT;
        REQUIRE(is_group, where, "must be a mapping", value.type(), "see ElevationMapConfig");
        return;
    }
    if (setting.kind == CHAIN) {
        REQUIRE(value.kind == Json::ARRAY, where, "must be a list", value.type(),
                "write one as {layer: smooth, filter: gaussian, sigma: 0.1}");
        filters = value;
        return;
    }
    if (setting.kind == ONLY_PYTHON) {
        const bool is_empty = value.kind == Json::OBJECT && value.members.empty() && std::string(setting.name) == "channels";
        REQUIRE(value.kind == Json::NUL || is_empty, where,
                "needs Python: this library has no " + std::string(setting.name), value.describe(),
                "leave it out, or run the map in Python", TORCHELEV_UNSUPPORTED);
        return;
    }
    if (setting.kind == GROUP) return read_group_setting(k, value);
    if (value.kind == Json::NUL) {
        REQUIRE(setting.is_nullable, where, "cannot be switched off", "None", "leave it out to keep its default");
        entries[k].is_null = true;
        return;
    }
    if (setting.kind == PLACE) return read_place(k, value);
    if (setting.kind == CHOICE) return read_choice(k, value);
    const bool is_infinite = value.kind == Json::STRING && (value.text == "inf" || value.text == "-inf");
    REQUIRE(value.kind == Json::NUMBER || is_infinite, where, "must be a number", value.describe(),
            "give a number without quotes");
    REQUIRE(setting.kind == NUMBER || (value.is_whole && std::fabs(value.number) < 2147483648.0), setting.name,
            "must be a positive int", value.describe(), "see its default");
    const double infinite = value.text == "inf" ? INFINITY : -INFINITY;
    entries[k].is_null = false, entries[k].values[0] = is_infinite ? infinite : value.number;
}

void Config::read_group_setting(size_t k, const Json& value) {
    const Setting& setting = SETTINGS[k];
    const std::string where = std::string("config.") + setting.name, name = setting.name;
    entries[k].is_null = value.kind == Json::NUL;
    if (value.kind == Json::NUL) {
        REQUIRE(setting.is_nullable, where, "cannot be switched off", "None", "leave it out to keep its default");
        return;
    }
    REQUIRE(value.kind == Json::OBJECT, where, "must be a mapping", value.type(), "see ElevationMapConfig");
    if (name == "sensor.body" && (value.find("capsules") || value.find("boxes"))) {
        entries[k].is_null = true;  // no box
        body = RobotBody(value);
        return;
    }
    // As in Python: `robot` alone is of the learned head.
    const bool is_learned = value.find("weights") || (value.members.size() == 1 && value.find("robot"));
    REQUIRE(name != "traversability" || !is_learned, where, "needs Python: this library has no learned head",
            "its settings", "give the analytic head, or null for no traversability", TORCHELEV_UNSUPPORTED);
    read_group(value, name + ".");
}

void Config::read_place(size_t k, const Json& value) {
    const std::string where = std::string("config.") + SETTINGS[k].name;
    bool fits = value.kind == Json::ARRAY && value.items.size() == 3;
    for (const Json& item : value.items) fits = fits && item.kind == Json::NUMBER;
    REQUIRE(fits, where, "must be three numbers", value.describe(), "give [x, y, z] in metres");
    for (int axis = 0; axis < 3; axis++) entries[k].values[axis] = value.items[axis].number;
}

void Config::read_choice(size_t k, const Json& value) {
    const std::vector<std::string> words = words_of(SETTINGS[k].name);
    const auto found = std::find(words.begin(), words.end(), value.text);
    const bool fits = value.kind == Json::STRING && found != words.end();
    REQUIRE(fits, SETTINGS[k].name, "must be one of " + joined(words), value.describe(), "use " + words[0]);
    entries[k].values[0] = double(found - words.begin());
}

std::string Config::word(const std::string& name) const { return words_of(name)[size_t((*this)[name])]; }

bool Config::has_levels() const { return has("levels") && (*this)["levels.max_levels"] > 1; }

int64_t Config::rows() const { return int64_t(std::nearbyint((*this)["grid.length_x"] / (*this)["grid.resolution"])); }

int64_t Config::columns() const {
    return int64_t(std::nearbyint((*this)["grid.length_y"] / (*this)["grid.resolution"]));
}

double Config::drift_gate() const {
    if (!has("traversability")) return 0;
    if (has("drift") && has("drift.min_traversability")) return (*this)["drift.min_traversability"];
    return default_settings().compensate.min_traversability;  // the analytic head's
}

std::string Config::canonical() const {
    std::string text;
    for (size_t k = 0; k < NUMBER_OF_SETTINGS; k++) {
        const Entry& entry = entries[k];
        const bool is_of_levels = std::string(SETTINGS[k].name).rfind("levels", 0) == 0;
        if (!is_of_state(SETTINGS[k].kind) || (is_of_levels && !has("levels"))) continue;
        text += SETTINGS[k].name;
        if (entry.is_null) text += " null";
        else if (SETTINGS[k].kind == PLACE)
            for (double value : entry.values) text += " " + repr(value);
        else if (SETTINGS[k].kind != GROUP) text += " " + repr(entry.values[0]);
        text += "\n";
    }
    return text + body.text;
}

// Rules --------------------------------------------------------------------------------------------------------------

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
