// What a diagnosis rests on: diagnosis/evidence.py.

#include "runtime/source/diagnosis/evidence.h"

#include <algorithm>
#include <cmath>

namespace {

using namespace diagnosis;
constexpr int RANGE = 1;  // number of the gate

bool is_finite(const float* p) { return std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]); }

double norm(const Place& p) { return std::sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]); }

Place minus(const Place& a, const Place& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }

Place position(const double* T) { return {T[3], T[7], T[11]}; }

}  // namespace

double median(std::vector<double> values) {
    const size_t middle = values.size() / 2;
    std::sort(values.begin(), values.end());
    return values.size() % 2 ? values[middle] : 0.5 * (values[middle - 1] + values[middle]);
}

Evidence::Evidence(torchelev_map& given) : map(given), updates(given.history.all()) {
    measure_again(given);
    find_distances();
    far_cloud = find_far_cloud();
    is_in_millimetres = !far_cloud.exists && is_beyond_range() &&
                        median(distances) >= std::max(FAR, 2 * map.cfg["sensor.max_distance"]);
    look_at_map();
    travel = 0;
    for (int axis = 0; axis < 3; axis++) {
        auto less = [axis](const Place& a, const Place& b) { return a[axis] < b[axis]; };
        const auto [least, most] = std::minmax_element(positions.begin(), positions.end(), less);
        travel = std::max(travel, (*most)[axis] - (*least)[axis]);
    }
}

void Evidence::measure_again(torchelev_map& given) {
    for (const PastUpdate* past : updates) {
        const Measurement& m = given.measure_again(*past);
        used.emplace_back(m.used.data(), m.used.data() + m.number);
        const int64_t passed[] = {m.number, m.counts.finite, m.counts.in_range, m.counts.casts, m.counts.used};
        for (int gate = 0; gate < 4; gate++) rejected[gate] += passed[gate] - passed[gate + 1];
        num_points += m.number, num_used += m.counts.used;
        positions.push_back(position(past->has_base ? past->base : past->pose(0)));
    }
}

void Evidence::find_distances() {
    for (const PastUpdate* past : updates)
        for (int64_t k = 0; k < past->sensors * past->points; k++) {
            const float* p = past->xyz.data() + 3 * k;
            if (is_finite(p)) distances.push_back(norm({p[0], p[1], p[2]}));
        }
}

bool Evidence::is_beyond_range() const {
    return distances.size() >= MIN_POINTS && 2 * rejected[RANGE] >= int64_t(distances.size());
}

FarCloud Evidence::find_far_cloud() const {
    if (!is_beyond_range()) return {};
    const PastUpdate* past = nullptr;
    std::vector<Place> cloud;
    const double* T = nullptr;
    for (const PastUpdate* update : updates)
        for (int64_t s = 0; s < update->sensors; s++) {
            std::vector<Place> found;
            for (int64_t k = s * update->points; k < (s + 1) * update->points; k++) {
                const float* p = update->xyz.data() + 3 * k;
                if (is_finite(p)) found.push_back({p[0], p[1], p[2]});
            }
            if (!found.empty()) past = update, cloud = found, T = update->pose(s);  // the last one
        }
    Place middle;
    std::vector<double> values(cloud.size());
    for (int axis = 0; axis < 3; axis++) {
        for (size_t k = 0; k < cloud.size(); k++) values[k] = cloud[k][axis];
        middle[axis] = median(values);
    }
    for (size_t k = 0; k < cloud.size(); k++) values[k] = norm(minus(cloud[k], middle));
    const double distance = norm(middle), radius = median(values);
    auto is_at = [&](const double* pose) { return norm(minus(middle, position(pose))) < 0.2 * distance; };
    const bool is_near = radius < std::min(0.2 * distance, map.cfg["sensor.max_distance"]);
    const bool is_elsewhere = is_at(T) || (past->has_base && is_at(past->base)) || distance >= FAR;
    return {is_near && is_elsewhere, is_at(T), distance, radius};
}

void Evidence::look_at_map() {
    const Sizes& sizes = map.sizes;
    const double side = map.resolution(), radius = map.cfg.has("overlap") ? map.cfg["overlap.radius"] : -1;
    const double corner[] = {double(map.state.corner[0]), double(map.state.corner[1])};
    center = {corner[0] * side + 0.5 * map.cfg["grid.length_x"], corner[1] * side + 0.5 * map.cfg["grid.length_y"], 0};
    const PastUpdate& last = *updates.back();
    for (int64_t k = 0; k < map.cells(); k++) {
        if (!map.state.validity[k]) continue;
        num_known++, oldest = std::max(oldest, double(map.state.time[k]));
        if (!last.has_base) continue;
        const double x = (corner[0] + double(k / sizes.W) + 0.5) * side - last.base[3];
        const double y = (corner[1] + double(k % sizes.W) + 0.5) * side - last.base[7];
        num_near += std::sqrt(x * x + y * y) <= radius;
    }
}

std::vector<Place> Evidence::used_points(size_t k) const {
    const PastUpdate& past = *updates[k];
    std::vector<Place> found;
    for (int64_t n = 0; n < past.sensors * past.points; n++) {
        if (!used[k][n]) continue;
        const double* T = past.pose(n / past.points);
        const float* p = past.xyz.data() + 3 * n;
        Place at;
        for (int row = 0; row < 3; row++)
            at[row] = T[4 * row] * p[0] + T[4 * row + 1] * p[1] + T[4 * row + 2] * p[2] + T[4 * row + 3];
        found.push_back(at);
    }
    return found;
}
