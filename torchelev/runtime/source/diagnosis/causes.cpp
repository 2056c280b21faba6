// Rules that find mistakes in a map's inputs, worst first, with the sentences of diagnosis/causes.py.

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>

#include "runtime/source/diagnosis/diagnose.h"
#include "runtime/source/diagnosis/evidence.h"

namespace {

using namespace diagnosis;

constexpr double NONE = NAN;

std::string fixed(double value, int digits) {
    char text[400];
    std::snprintf(text, sizeof text, "%.*f", digits, value);
    return text;
}

// A number as Python prints it with `:,.{digits}f`.
std::string grouped(double value, int digits = 0) {
    std::string all = fixed(value, digits);
    const size_t point = std::min(all.find('.'), all.size());
    for (size_t k = point; k > 3 + (all[0] == '-'); k -= 3) all.insert(k - 3, ",");
    return all;
}

std::string find_millimetres(const Evidence& seen) {
    if (!seen.is_in_millimetres) return "";
    return "points: the median distance is " + grouped(median(seen.distances)) +
           " m, as of millimetres: check units, and multiply them by 0.001";
}

std::string find_far_cloud(const Evidence& seen) {
    const FarCloud& cloud = seen.far_cloud;
    if (!cloud.exists) return "";
    const std::string where = "points: they lie " + grouped(cloud.distance) + " m from the sensor and within " +
                              grouped(cloud.radius, 1) + " m of each other";
    if (cloud.is_at_sensor)
        return where +
               ", where T_map_sensor has the sensor: they are in the map frame already, and the pose is applied twice; "
               "give sensor-frame points, inverse(T_map_sensor) times these";
    return where +
           ": they are in the map's frame, such as a national grid, and T_map_sensor lacks the sensor's place in it; "
           "give its pose in that frame, and sensor-frame points: subtract its position in float64";
}

// Sensor poses that were left out, as of points that are in the map frame already.
std::string find_missing_pose(const Evidence& seen) {
    double low[] = {INFINITY, INFINITY, INFINITY}, high[] = {-INFINITY, -INFINITY, -INFINITY}, moved = 0;
    for (const PastUpdate* past : seen.updates) {
        for (int k = 0; k < 16; k++)
            if (past->pose(0)[k] != (k % 5 == 0 ? 1.0 : 0.0)) return "";
        for (int k = 0; past->has_base && k < 3; k++)
            low[k] = std::min(low[k], past->base[4 * k + 3]), high[k] = std::max(high[k], past->base[4 * k + 3]);
    }
    for (int k = 0; k < 3; k++) moved = std::max(moved, high[k] - low[k]);
    if (moved < 0.5) return "";
    return "T_map_sensor: it is the identity in all updates, while the base moves by " + fixed(moved, 1) +
           " m; give the sensor's pose, and points in its own frame: their rays start there";
}

// A sensor that moves against the base it is mounted on; sensors that take turns return to their mounts.
std::string find_wrong_base(const Evidence& seen) {
    std::vector<Place> mounts;
    for (const PastUpdate* past : seen.updates) {
        if (!past->has_base) continue;
        const double *T = past->base, *S = past->pose(0), away[] = {S[3] - T[3], S[7] - T[7], S[11] - T[11]};
        Place mount;
        for (int k = 0; k < 3; k++) mount[k] = T[k] * away[0] + T[4 + k] * away[1] + T[8 + k] * away[2];
        mounts.push_back(mount);
    }
    double farthest = 0;
    size_t single = 0;
    for (const Place& a : mounts) {
        int near = 0;
        for (const Place& b : mounts) {
            const double apart = std::hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
            near += apart < 0.1, farthest = std::max(farthest, apart);
        }
        single += near == 1;
    }
    if (mounts.size() < 4 || farthest < 0.5 || 2 * single < mounts.size()) return "";
    return "T_map_base: the sensor moves by " + fixed(farthest, 1) +
           " m against the base; check T_map_base and T_map_sensor: poses in the same map frame, of the same time, and "
           "not inverted";
}

// The range [m] of the heights that repeat with a period; NONE without.
double repeated_range(const double* corrections, size_t number, size_t period) {
    const double all = std::accumulate(corrections, corrections + number, 0.0) / double(number);
    std::vector<double> mean(period);
    for (size_t k = 0; k < number; k++) mean[k % period] += (corrections[k] - all) * double(period) / double(number);
    double total = 0, left = 0, height = 0, lowest = INFINITY, highest = -INFINITY;
    for (size_t k = 0; k < number; k++) {
        const double value = corrections[k] - all, rest = value - mean[k % period];
        total += value * value, left += rest * rest;
    }
    for (double part : mean)
        height += part, lowest = std::min(lowest, height), highest = std::max(highest, height);
    return left < (1 - MIN_EXPLAINED) * total ? highest - lowest : NONE;
}

// Drift corrections that repeat: sensors that take turns, or phases of a gait, have their own height offsets.
std::string find_alternating_corrections(const Evidence& seen) {
    std::vector<double> corrections = seen.map.history.past_corrections();
    corrections.push_back(*seen.map.state.statistics.drift_correction);
    for (size_t period = 2; period <= MAX_TURNS; period++) {
        const size_t number = corrections.size() / period * period;
        if (number < MIN_TURNS * period) return "";
        const double range = repeated_range(corrections.data() + corrections.size() - number, number, period);
        if (range >= MIN_BIAS)
            return "sensors or poses: drift compensation moves the map by " + fixed(100 * range, 1) +
                   " cm and back, every " + std::to_string(period) +
                   " updates: sensors take turns and disagree in height, or poses lag behind a robot that sways; "
                   "calibrate the heights at which they are mounted, or take poses at the scans' time stamps";
    }
    return "";
}

// Sensor gates that reject nearly all points.
std::string find_closed_gate(const Evidence& seen) {
    if (seen.num_points < MIN_POINTS || seen.is_in_millimetres || seen.far_cloud.exists) return "";
    std::string counts;
    const double points = double(seen.num_points), invalid = double(seen.rejected[0]);
    for (int k = 0; k < 4; k++) {
        const double tested = points - (k ? invalid : 0), rejected = double(seen.rejected[k]);
        if (tested >= MIN_POINTS && rejected >= 0.95 * tested)
            return "points: " + grouped(rejected) + " of " + grouped(tested) + " " + GATES[k].reason;
        if (rejected > 0) counts += (counts.empty() ? "" : ", ") + grouped(rejected) + " " + GATES[k].name;
    }
    if (double(seen.num_used) >= 0.01 * points || invalid > 0.9 * points) return "";
    return "points: the sensor's gates let " + grouped(double(seen.num_used)) + " of " + grouped(points) + " pass (" +
           counts + "); check poses and sensor=...";
}

// A window that nearly all points miss, in every update.
std::string find_window_off_points(const Evidence& seen) {
    const double half_x = 0.5 * seen.map.cfg["grid.length_x"], half_y = 0.5 * seen.map.cfg["grid.length_y"];
    double least = INFINITY, last = 0, away = 0;
    for (size_t k = 0; k < seen.updates.size(); k++) {
        const std::vector<Place> points = seen.used_points(k);
        if (points.size() < MIN_POINTS) continue;
        const PastUpdate& past = *seen.updates[k];
        const double x = past.has_base ? past.base[3] : seen.center[0], y = past.has_base ? past.base[7] : seen.center[1];
        size_t beside = 0;
        for (const Place& p : points) beside += std::fabs(p[0] - x) > half_x || std::fabs(p[1] - y) > half_y;
        last = double(beside) / double(points.size()), least = std::min(least, last);
        away = std::hypot(past.pose(0)[3] - x, past.pose(0)[7] - y);
    }
    if (std::isinf(least) || least < 0.95) return "";
    std::string hint = "enlarge grid.length_x and grid.length_y";
    if (away > std::max(half_x, half_y))
        hint = seen.updates.back()->has_base ? "check T_map_base" : "give T_map_base, which the window follows";
    return "window: " + fixed(100 * last, 0) + " % of the points fall beside it, and its centre is " + fixed(away, 1) +
           " m from the sensor; " + hint;
}

// A stage that clears most of the cells it works on, in one update.
std::string find_clearing(const Evidence& seen) {
    const Statistics& s = seen.map.state.statistics;
    auto sentence = [&](int64_t number, const char* reason) {
        return "map: " + grouped(double(number)) + " cells were cleared and " + grouped(double(seen.num_known)) +
               " are left, " + reason;
    };
    const int64_t floors = *s.cleared_other_floors, rays = *s.cleared_seen_through;
    if (floors >= MIN_POINTS && 4 * seen.num_near < floors)
        return sentence(floors, "as other floors: check T_map_base, and overlap.height");
    if (rays >= MIN_POINTS && seen.num_known < rays)
        return sentence(rays, "as rays pass below them: check the poses' heights, and raycast");
    return "";
}

// Whether points of one scan differ in height within cells, as on vegetation.
bool is_overgrown(const Evidence& seen) {
    std::vector<double> spreads;
    for (size_t k = 0; k < seen.updates.size(); k++) {
        const std::vector<Place> points = seen.used_points(k);
        if (points.size() < MIN_POINTS) continue;
        std::map<std::pair<double, double>, std::vector<double>> cells;
        for (const Place& p : points)
            cells[{std::floor(p[0] / CELL_SIZE), std::floor(p[1] / CELL_SIZE)}].push_back(p[2]);
        for (const auto& [cell, heights] : cells) {
            if (heights.size() < MIN_IN_CELL) continue;
            const double number = double(heights.size());
            const double mean = std::accumulate(heights.begin(), heights.end(), 0.0) / number;
            double square = 0;
            for (double z : heights) square += (z - mean) * (z - mean);
            spreads.push_back(std::sqrt(square / number));
        }
    }
    return spreads.size() >= MIN_POINTS && median(spreads) > SPREAD;
}

// Scans that contradict the map: the outlier gate rejects a large part of them.
std::string find_contradictions(const Evidence& seen) {
    const int64_t outliers = *seen.map.state.statistics.rejected_outlier;
    const int64_t total = outliers + *seen.map.state.statistics.points_used;
    if (outliers < MIN_POINTS || double(outliers) < 0.3 * double(total) || is_overgrown(seen)) return "";
    return "poses: " + fixed(100 * double(outliers) / double(total), 0) +
           " % of the points contradict the map; check that poses belong to their scans and that the map's z axis points "
           "up; see fusion.gate";
}

// A `dt` that is implausibly long for the robot's motion, or 0 in every update.
std::string find_wrong_dt(const Evidence& seen) {
    std::vector<double> times, moved;
    for (const PastUpdate* past : seen.updates) times.push_back(past->dt);
    const double dt = median(times);
    if (dt == 0 && seen.oldest == 0 && seen.positions.size() >= 4 && seen.travel > 0.5)
        return "dt: 0 s in all updates, yet the robot moves " + fixed(seen.travel, 1) +
               " m; give the seconds since the last one";
    if (dt < 5) return "";
    for (size_t k = 1; k < seen.updates.size(); k++) {
        const Place &a = seen.positions[k - 1], &b = seen.positions[k];
        const int64_t turns = std::max<int64_t>(1, seen.updates[k]->number - seen.updates[k - 1]->number);
        moved.push_back(std::hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]) / double(turns));
    }
    const double speed = moved.empty() ? 0 : median(moved) / dt;
    if (speed >= 0.05 || (dt < 10 && speed <= 0)) return "";
    return "dt: " + general(dt) + " s between updates, in which the robot moves " + general(100 * speed, 2) +
           " cm/s; give seconds, not ms or ns";
}

}  // namespace

std::string diagnose(torchelev_map& map) {
    if (map.history.all().empty()) return "";
    const Evidence seen(map);
    std::string all;
    for (const auto rule : {find_millimetres, find_far_cloud, find_missing_pose, find_wrong_base,
                            find_alternating_corrections, find_closed_gate, find_window_off_points, find_clearing, find_contradictions,
                            find_wrong_dt}) {
        const std::string sentence = rule(seen);
        if (!sentence.empty()) all += sentence + "\n";
    }
    return all;
}
