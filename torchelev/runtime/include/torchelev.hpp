// C++ on top of torchelev.h: objects that free themselves, and exceptions with the library's sentences.
#ifndef TORCHELEV_HPP
#define TORCHELEV_HPP

#include <array>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "torchelev.h"

namespace torchelev {

using Pose = std::array<double, 16>;  // (4, 4), row by row

// What the library refused.
struct Error : std::runtime_error {
    torchelev_status status;
    explicit Error(torchelev_status status) : std::runtime_error(torchelev_last_error()), status(status) {}
};

inline void check(torchelev_status status) {
    if (status != TORCHELEV_OK) throw Error(status);
}

class Map {
    std::unique_ptr<torchelev_map, decltype(&torchelev_map_free)> map{nullptr, &torchelev_map_free};

  public:
    // A map of a config file.
    explicit Map(const std::string& config_path, torchelev_limits limits = {131072, 4, 1}) {
        torchelev_map* made = nullptr;
        check(torchelev_map_create(config_path.c_str(), &limits, &made));
        map.reset(made);
    }

    void update(const torchelev_input& input) { check(torchelev_map_update(map.get(), &input)); }

    // Points (N, 3) of one sensor, seen from T_map_sensor.
    void update(const std::vector<float>& points, const Pose& T_map_sensor, const Pose& T_map_base, double dt) {
        if (points.size() % 3)
            throw std::invalid_argument("points: must be x, y, z of each, got " + std::to_string(points.size()) +
                                        " numbers; give (N, 3)");
        update({1, int64_t(points.size() / 3), points.data(), T_map_sensor.data(), T_map_base.data(), nullptr, dt,
                nullptr, nullptr});
    }

    void move(const Pose& T_map_base) { check(torchelev_map_move(map.get(), T_map_base.data())); }
    void reset() { check(torchelev_map_reset(map.get())); }

    // Estimate the unknown cells from ground points (K, 3) [m], "linear" within their hull, or "nearest".
    void initialize(const std::vector<double>& feet, const std::string& method = "linear") {
        check(torchelev_map_initialize(map.get(), feet.data(), int64_t(feet.size() / 3), method.c_str()));
    }

    // Forget the cells within a radius [m] of a place (x, y) [m].
    void clear_around(const std::array<double, 2>& center, double radius) {
        check(torchelev_map_clear_around(map.get(), center.data(), radius));
    }

    void save(const std::string& path) const { check(torchelev_map_save(map.get(), path.c_str())); }
    void load(const std::string& path) { check(torchelev_map_load(map.get(), path.c_str())); }

    // H and W, the cells along x and y.
    std::array<int64_t, 2> size() const {
        std::array<int64_t, 2> found;
        check(torchelev_map_size(map.get(), &found[0], &found[1], nullptr));
        return found;
    }

    // Position [m] of the window's corner: cell (i, j) spans i to i + 1 cells along x from it, and j to j + 1 along y.
    std::array<double, 2> corner() const {
        std::array<double, 2> found;
        check(torchelev_map_corner(map.get(), found.data()));
        return found;
    }

    // A layer (H, W), NaN where not known: cell (i, j) is value i * W + j.
    std::vector<float> layer(const std::string& name) const {
        std::vector<float> values(size_t(size()[0] * size()[1]));
        check(torchelev_map_layer(map.get(), name.c_str(), values.data(), values.size()));
        return values;
    }

    torchelev_statistics statistics() const {
        torchelev_statistics found;
        check(torchelev_map_statistics(map.get(), &found));
        return found;
    }

    // What looks wrong with the inputs, a sentence on each line.
    std::string diagnose() {
        const char* found = nullptr;
        check(torchelev_map_diagnose(map.get(), &found));
        return found;
    }

    const torchelev_map* get() const { return map.get(); }
};

// The heights that a policy reads.
class HeightScan {
    std::unique_ptr<torchelev_scan, decltype(&torchelev_scan_free)> scan{nullptr, &torchelev_scan_free};

  public:
    std::vector<float> values;  // of the last call

    // "isaac_lab", "mjlab", "legged_gym", or a layout as JSON.
    HeightScan(const Map& map, const std::string& layout) {
        torchelev_scan* made = nullptr;
        check(torchelev_scan_create(map.get(), layout.c_str(), &made));
        scan.reset(made);
        values.resize(size_t(torchelev_scan_size(made)));
    }

    const std::vector<float>& operator()(const Map& map, const Pose& T_map_base) {
        check(torchelev_scan_read(scan.get(), map.get(), T_map_base.data(), nullptr, values.data(), nullptr));
        return values;
    }
};

// An image of the map around the robot.
class MapImage {
    std::unique_ptr<torchelev_image, decltype(&torchelev_image_free)> image{nullptr, &torchelev_image_free};

  public:
    std::array<int64_t, 3> shape{};  // channels, rows, columns
    std::vector<float> values;       // of the last call

    // The fields of `MapImage` in Python, as JSON.
    MapImage(const Map& map, const std::string& settings) {
        torchelev_image* made = nullptr;
        check(torchelev_image_create(map.get(), settings.c_str(), &made));
        image.reset(made);
        check(torchelev_image_shape(made, shape.data()));
        values.resize(size_t(shape[0] * shape[1] * shape[2]));
    }

    const std::vector<float>& operator()(const Map& map, const Pose& T_map_base) {
        check(torchelev_image_read(image.get(), map.get(), T_map_base.data(), values.data()));
        return values;
    }
};

}  // namespace torchelev

#endif
