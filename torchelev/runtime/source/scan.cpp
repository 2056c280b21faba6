// Height scans without Python: height_scan.py, scan/settings.py and scan_layout.py.

#include "runtime/source/scan.h"

#include <algorithm>
#include <cmath>

#include "runtime/source/layout.h"

namespace {

constexpr double REACH = 0.6;  // [m] of feet from the base, of `HeightScan.feet`

const Preset* find_preset(const std::string& name) {
    for (const Preset& preset : PRESETS)
        if (name == preset.name) return &preset;
    return nullptr;
}

const std::initializer_list<const char*> KEYS = {
    "pattern",  "alignment",       "mode",          "nominal_height", "clip", "scale", "fill",
    "original", "standing_height", "inpaint_rings", "num_feet",       "reach"};

constexpr scans::Fill NO_RULE = scans::NONE;

// A fill: its rule, and the number that it reads where nothing has a height; NAN: as over flat ground.
struct Rule {
    scans::Fill fill = NO_RULE;
    double value = NAN;
    bool is_original = false;
};

Rule rule_of(const std::string& name, const Json& value, const char* usual) {
    if (value.kind == Json::NUMBER) return {NO_RULE, value.number};
    const bool is_name = value.kind == Json::STRING || value.kind == Json::NUL;
    REQUIRE(is_name, name, "must be the name of a rule or a number", value.describe(), std::string("use ") + usual);
    const std::string text = value.kind == Json::STRING ? value.text : usual;
    if (text == "inf" || text == "-inf") return {NO_RULE, text == "inf" ? INFINITY : -INFINITY};
    switch (place_of(name, text, {"ground", "original", "base", "lowest", "upper_bound", "inpaint"})) {
        case 0:
            return {scans::GROUND};
        case 1:
            return {NO_RULE, NAN, true};
        case 2:
            return {NO_RULE};
        case 3:
            return {scans::LOWEST};
        case 4:
            return {scans::UPPER_BOUND};
        default:
            return {scans::INPAINT};
    }
}

}  // namespace

torchelev_scan::torchelev_scan(const torchelev_map& map, const std::string& layout) {
    std::vector<double> xy;
    double reach = 0;
    if (const Preset* preset = find_preset(layout)) use_preset(*preset, xy);
    else {
        const bool is_json = layout.find('{') != std::string::npos;
        REQUIRE(is_json, "layout", "must be one of isaac_lab, mjlab, legged_gym, or JSON", "'" + layout + "'",
                "use isaac_lab");
        reach = read_layout(layout, xy);
    }
    scan.points = int64_t(xy.size() / 2), scan.environments = 1;
    pattern.assign(xy.begin(), xy.end());
    place_in(map, xy, reach);
    scan.pattern = pattern.data();
    own_known.resize(size());
    robot = std::make_unique<scans::Robot>(scan);
    read_blank(map);
}

void torchelev_scan::use_preset(const Preset& preset, std::vector<double>& xy) {
    const int outer = preset.is_x_fastest ? preset.num_y : preset.num_x;
    const int inner = preset.is_x_fastest ? preset.num_x : preset.num_y;
    for (int a = 0; a < outer; a++)
        for (int b = 0; b < inner; b++) {
            xy.push_back(preset.x[preset.is_x_fastest ? b : a]);
            xy.push_back(preset.y[preset.is_x_fastest ? a : b]);
        }
    scan.mode = preset.mode, scan.alignment = scans::YAW, scan.fill = scans::GROUND, scan.rings = 5, scan.origins = 1;
    scan.nominal_height = float(preset.nominal_height), scan.clip = float(preset.clip),
    scan.scale = float(preset.scale);
    scan.missing = float(preset.standing_height - preset.nominal_height);
}

// Read a layout; return how far [m] feet may be from the base.
double torchelev_scan::read_layout(const std::string& text, std::vector<double>& xy) {
    const Layout layout("layout", text, KEYS);
    xy = layout.points();
    scan.alignment = layout.choice("alignment", "yaw", {"yaw", "base", "world"});
    scan.mode = layout.choice("mode", "bilinear", {"bilinear", "nearest", "minimum"});
    const double nominal = layout.number("nominal_height", 0), clip = layout.number("clip", INFINITY);
    REQUIRE(clip > 0, "clip", "must be a positive number", repr(clip), "give metres");
    scan.nominal_height = float(nominal), scan.clip = float(clip), scan.scale = float(layout.number("scale", 1));
    scan.rings = int32_t(layout.count("inpaint_rings", 5));
    Rule rule = rule_of("layout.fill", layout["fill"], "ground");
    if (rule.is_original) rule = rule_of("layout.original", layout["original"], "base");
    REQUIRE(!rule.is_original, "layout.original", "must name a rule", "'original'", "use base");
    REQUIRE(!std::isinf(rule.value) || std::isfinite(clip), "layout.fill", "must be finite without a clip",
            repr(rule.value), "give a clip");
    const double standing = layout.number("standing_height", nominal);
    scan.fill = rule.fill, scan.missing = float(std::isnan(rule.value) ? standing - nominal : rule.value);
    num_feet = layout.count("num_feet", 0);
    scan.origins = std::max<int64_t>(1, num_feet);
    return layout.number("reach", num_feet ? REACH : 0, 0);
}

// What the map's grid decides, and whether the window holds the points at every heading: patterns.py and ground.py.
void torchelev_scan::place_in(const torchelev_map& map, const std::vector<double>& xy, double reach) {
    const double size = map.resolution();
    const Span span(xy, scan.alignment, reach);
    span.require_inside(map.cfg);
    scan.resolution = size, scan.height = map.sizes.H, scan.width = map.sizes.W;
    scan.num_near = 1 + std::max(0, int(std::floor(std::log2(MAX_BLOCK / size))));
    const int64_t margin = scan.fill == scans::INPAINT ? scan.rings : int64_t(std::ceil(MARGIN / size));
    auto left_out = [&](int64_t cells, double reached) {
        return std::max<int64_t>(0, cells / 2 - (int64_t(std::ceil(reached / size)) + 1) - margin);
    };
    scan.top = left_out(scan.height, span.x), scan.left = left_out(scan.width, span.y);
}

// Read where nothing is known, so that later reads allocate nothing.
void torchelev_scan::read_blank(const torchelev_map& map) {
    std::vector<uint8_t> nothing(map.cells()), known(size());
    std::vector<float> values(size()), heights(map.cells());
    std::vector<double> feet(3 * scan.origins);
    const double T[] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    const size_t room = size_t(scan.height - 2 * scan.top + 2) * size_t(scan.width - 2 * scan.left + 1 + LANES) + LANES;
    for (scans::Part* part : {&robot->inpainted.now, &robot->inpainted.next})
        if (scan.fill == scans::INPAINT) part->heights.reserve(room);  // at any heading
    const int64_t corner[] = {-(scan.height / 2), -(scan.width / 2)};
    scan.elevation = scan.upper_bound = heights.data(), scan.validity = scan.bounded = nothing.data();
    scan.corner = corner, scan.pose = T, scan.feet = num_feet ? feet.data() : nullptr;
    scan.values = values.data(), scan.valid = known.data();
    robot->read_all();
}

void torchelev_scan::read(const torchelev_map& map, const double* T_map_base, const double* feet, float* values,
                          uint8_t* known) {
    require_poses("T_map_base", T_map_base, 1);
    map.require_grid(scan.height, scan.width, scan.resolution, "scan");
    REQUIRE(bool(feet) == bool(num_feet), "feet",
            num_feet ? "must be given for a scan around feet" : "must be left out",
            feet ? "feet for a scan around the base" : "null", "use a layout with num_feet for feet only");
    for (int64_t k = 0; feet && k < 3 * num_feet; k++)
        REQUIRE(std::isfinite(feet[k]), "feet", "must be finite", "NaN or inf", "leave those feet out");
    scan.pose = T_map_base, scan.feet = feet, scan.corner = map.state.corner;
    scan.elevation = map.state.elevation, scan.validity = map.state.validity;
    scan.upper_bound = map.state.upper_bound, scan.bounded = map.state.bounded;
    scan.values = values, scan.valid = known ? known : own_known.data();
    robot->read_all();
}
