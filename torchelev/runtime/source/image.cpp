// Images of the map without Python: map_image.py.

#include "runtime/source/image.h"

#include <algorithm>
#include <cmath>

#include "runtime/source/layout.h"

namespace {

const std::initializer_list<const char*> KEYS = {"length_x", "length_y",  "resolution", "offset",
                                                 "layers",   "alignment", "mode",       "nominal_height",
                                                 "max_clearance"};
const std::initializer_list<const char*> CHANNELS = {"elevation", "validity", "variance", "upper_bound",
                                                     "traversability", "clearance"};

constexpr int64_t MOST_PIXELS = 1 << 24;

int64_t pixels_along(const Layout& layout, const char* key, double resolution) {
    const double length = layout.number(key, 1.6), pixels = length / resolution, whole = std::nearbyint(pixels);
    REQUIRE(length > 0, key, "must be a positive number", repr(length), "give metres");
    REQUIRE(whole >= 1 && std::fabs(pixels - whole) < 1e-6 * pixels && whole < 1e5, key,
            "must be a whole number of times " + general(resolution) + " m", general(pixels) + " times",
            "try " + general(std::max(1.0, whole) * resolution));
    return int64_t(whole);
}

std::vector<std::string> channels_of(const Layout& layout, bool has_levels) {
    const Json& layers = layout["layers"];
    if (layers.kind == Json::NUL) return {"elevation", "validity", "upper_bound", "traversability"};
    std::vector<std::string> names;
    for (const Json& layer : layers.items) {
        place_of("image.layers", layer.text, CHANNELS);
        REQUIRE(layer.text != "clearance" || has_levels, "image.layers", "needs a map with levels, which knows ceilings",
                "'clearance'", "give the map levels, or leave it out");
        const bool is_new = std::find(names.begin(), names.end(), layer.text) == names.end();
        REQUIRE(is_new, "image.layers", "must name each channel once", "'" + layer.text + "' twice", "leave one out",
                TORCHELEV_UNSUPPORTED);
        names.push_back(layer.text);
    }
    REQUIRE(!names.empty(), "image.layers",
            "must be some of " + joined(CHANNELS), layers.describe(),
            "correct their names");
    return names;
}

}  // namespace

torchelev_image::torchelev_image(const torchelev_map& map, const std::string& text) {
    const Layout layout("image", text, KEYS);
    const double resolution = layout.number("resolution", 0.05);
    REQUIRE(resolution > 0, "resolution", "must be a positive number", repr(resolution), "give metres");
    const Json& offset = layout["offset"];
    bool fits = offset.kind == Json::NUL || (offset.kind == Json::ARRAY && offset.items.size() == 2);
    for (const Json& item : offset.items) fits = fits && item.kind == Json::NUMBER && std::isfinite(item.number);
    REQUIRE(fits, "image.offset", "must be two numbers", offset.describe(), "give [x, y] in metres");
    const double middle[] = {offset.items.empty() ? 0 : offset.items[0].number,
                             offset.items.empty() ? 0 : offset.items[1].number};
    shape[1] = pixels_along(layout, "length_x", resolution), shape[2] = pixels_along(layout, "length_y", resolution);
    const bool is_small = double(shape[1]) * double(shape[2]) <= double(MOST_PIXELS);
    REQUIRE(is_small, "image", "must have at most 2^24 pixels",
            std::to_string(shape[1]) + " x " + std::to_string(shape[2]), "use larger pixels");
    std::vector<double> xy;
    for (int64_t i = 0; i < shape[1]; i++)
        for (int64_t j = 0; j < shape[2]; j++) {
            xy.push_back(middle[0] + (double(i) - double(shape[1] - 1) / 2) * resolution);
            xy.push_back(middle[1] + (double(j) - double(shape[2] - 1) / 2) * resolution);
        }
    settings.alignment = layout.choice("alignment", "yaw", {"yaw", "base", "world"});
    settings.mode = layout.choice("mode", "bilinear", {"bilinear", "nearest", "minimum"});
    settings.nominal_height = float(layout.number("nominal_height", 0));
    max_clearance = float(layout.number("max_clearance", 3));
    REQUIRE(max_clearance > 0, "max_clearance", "must be a positive number", repr(max_clearance), "give metres");
    Span(xy, settings.alignment, 0).require_inside(map.cfg);
    pattern.assign(xy.begin(), xy.end());
    const std::vector<std::string> channels = channels_of(layout, map.levels != nullptr);
    settings.pattern = pattern.data(), settings.resolution = map.resolution();
    settings.B = 1, settings.P = shape[1] * shape[2], settings.channels = shape[0] = int64_t(channels.size());
    settings.height = map.sizes.H, settings.width = map.sizes.W;
    add_sources(map, channels);
    settings.sources = sources.data(), settings.num_sources = int64_t(sources.size());
    pixels = std::make_unique<images::Pixels>(settings);
}

// The layers that the channels are read from: "validity" is that of the elevation, "upper_bound" the elevation and,
// where that is not known, the bound.
void torchelev_image::add_sources(const torchelev_map& map, const std::vector<std::string>& channels) {
    auto place = [&](const char* name) {
        const auto found = std::find(channels.begin(), channels.end(), name);
        return found == channels.end() ? int64_t(-1) : int64_t(found - channels.begin());
    };
    auto add = [&](Layer layer, int64_t channel, int64_t validity, bool is_height) {
        if (channel < 0 && validity < 0) return;
        layers.push_back(layer);
        sources.push_back({nullptr, nullptr, nullptr, nullptr, channel, validity, is_height});
    };
    add(VARIANCE, place("variance"), -1, false);
    add(TRAVERSABILITY, place("traversability"), -1, false);
    add(CLEARANCE, place("clearance"), -1, false);
    values.resize(map.cells() * sources.size()),
        known.resize(values.size());  // of these; the others are the state's
    add(ELEVATION, place("elevation"), place("validity"), true);
    add(UPPER_BOUND, place("upper_bound"), -1, true);
}

// Point a source at its layer: at the state, or at cells that are computed here.
void torchelev_image::look_at(const torchelev_map& map, size_t k) {
    images::Source& source = sources[k];
    const MapState& state = map.state;
    const bool is_bound = layers[k] == UPPER_BOUND;
    if (is_bound || layers[k] == ELEVATION) {
        source.values = state.elevation, source.known = state.validity;
        if (is_bound) source.second = state.upper_bound, source.second_known = state.bounded;
        return;
    }
    float* to = &values[map.cells() * k];
    uint8_t* flags = &known[map.cells() * k];
    for (int64_t cell = 0; cell < map.cells(); cell++) {
        const CellValue found = map.read(layers[k], cell);
        to[cell] = layers[k] == CLEARANCE ? std::min(found.value, max_clearance) : found.value;
        flags[cell] = found.known;
    }
    source.values = to, source.known = flags;
}

void torchelev_image::read(const torchelev_map& map, const double* T_map_base, float* to) {
    require_poses("T_map_base", T_map_base, 1);
    map.require_grid(settings.height, settings.width, settings.resolution, "image");
    for (size_t k = 0; k < sources.size(); k++) look_at(map, k);
    settings.pose = T_map_base, settings.corner = map.state.corner, settings.images = to;
    pixels->show(0);
}
