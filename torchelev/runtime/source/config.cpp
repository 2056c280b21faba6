// Reading settings; their rules are in config_rules.cpp.
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
