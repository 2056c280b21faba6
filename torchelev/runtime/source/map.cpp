// A map that is updated in place, without Python: elevation_map.py.

#include "runtime/source/map.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "runtime/source/team.h"

namespace {

constexpr torchelev_limits USUAL{131072, 4, 1};

torchelev_limits checked_limits(const torchelev_limits* given) {
    const torchelev_limits limits = given ? *given : USUAL;
    auto require_positive = [](const char* name, int64_t value, int64_t most, const char* hint) {
        REQUIRE(value > 0 && value <= most, name, "must be from 1 to " + std::to_string(most), std::to_string(value),
                hint);
    };
    require_positive("limits.max_points", limits.max_points, int64_t(1) << 30, "give the points of a scan");
    require_positive("limits.max_sensors", limits.max_sensors, 1 << 10, "give the number of sensors");
    require_positive("limits.num_threads", limits.num_threads, 1 << 10, "give the number of free cores");
    return limits;
}

template <class T>
void fill(void* to, int64_t count, double value) {
    std::fill_n(static_cast<T*>(to), count, T(value));
}

void fill_tensor(const Tensor& tensor, void* to, int64_t count) {
    const std::string dtype = tensor.dtype;
    if (dtype == "F32") return fill<float>(to, count, tensor.blank);
    if (dtype == "I64") return fill<int64_t>(to, count, tensor.blank);
    fill<uint8_t>(to, count, tensor.blank);
}

}  // namespace

// Creation -----------------------------------------------------------------------------------------------------------

torchelev_map::torchelev_map(const std::string& text, const std::string& where, const torchelev_limits* given)
    : cfg(text, where), settings(settings_of(cfg)), sizes{}, limits(checked_limits(given)), dt(0),
      filters(cfg.filters.items, {cfg.rows(), cfg.columns(), settings.measure.resolution},
              layers_of(cfg)) {
    sizes.B = 1, sizes.H = cfg.rows(), sizes.W = cfg.columns();
    void* addresses[NUMBER_OF_TENSORS];
    for (size_t k = 0; k < NUMBER_OF_TENSORS; k++) {
        std::vector<int64_t> shape;
        for (const int64_t size : STATE[k].shape)
            if (size) shape.push_back(size == ROWS ? sizes.H : size == COLUMNS ? sizes.W : size);
        stored.push_back({STATE[k].name, STATE[k].dtype, shape, nullptr, STATE[k].size, false});
        tensors.emplace_back(new unsigned char[stored[k].bytes()]);
        stored[k].data = addresses[k] = tensors[k].get();
    }
    static_assert(sizeof(MapState) == sizeof addresses && std::size(STATE) == NUMBER_OF_TENSORS);
    std::memcpy(static_cast<void*>(&state), addresses, sizeof state);
    if (cfg.has_levels()) levels = std::make_unique<MapLevels>(cfg, settings.levels);
    if (levels)
        for (const Stored& tensor : levels->stored()) stored.push_back(tensor);
    covariance.resize(36 * limits.max_sensors);
    if (!cfg.body.links.empty()) on_robot.resize(limits.max_points);
    history.resize(limits);
    Team::use();
    if (limits.num_threads > 1) Team::shared()->grow(limits.num_threads - 1);
    warm_up();
    forget();
}

const Stored& torchelev_map::find(const std::string& name) const {
    const auto found = std::find_if(stored.begin(), stored.end(), [&](const Stored& one) { return name == one.name; });
    REQUIRE(found != stored.end(), "name", "must be a tensor of MapState", "'" + name + "'", "use elevation");
    return *found;
}

void torchelev_map::forget() {
    for (size_t k = 0; k < NUMBER_OF_TENSORS; k++) fill_tensor(STATE[k], tensors[k].get(), stored[k].count());
    state.corner[0] = -(sizes.H / 2), state.corner[1] = -(sizes.W / 2);
    if (levels) levels->forget();
    history.forget(), filters.forget();
}

// Run the largest updates, so that later ones allocate nothing: first a point in each cell, then rays to the farthest
// range. No gate rejects these points.
void torchelev_map::warm_up() {
    const double T[] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 1}, size = resolution();
    std::vector<float> points(3 * limits.max_points), variance(limits.max_points, 1e-4f);
    std::vector<double> poses, links, covariances(36 * limits.max_sensors, 0.0);
    for (int k = 0; k < limits.max_sensors; k++) poses.insert(poses.end(), T, T + 16);
    for (size_t k = 0; k < cfg.body.links.size(); k++) links.insert(links.end(), T, T + 16);
    if (!links.empty()) posed.pose(cfg.body.packed(), T, T, links.data());
    const Settings usual = settings;
    settings.measure.min_square = 0, settings.measure.max_square = settings.measure.max_distance = 1e30f;
    settings.measure.has_ramp = settings.measure.has_box = 0;
    const double reach = settings.visibility.ranges + 2, diagonal = 0.5 * std::hypot(double(sizes.H), double(sizes.W));
    for (const float scale : {1.0f, std::max(2.5f, float(reach / diagonal))})
        for (const int sensors : {limits.max_sensors, 1}) {
            if (scale > 1 && sensors == 1 && limits.max_sensors > 1) continue;  // several sensors reach as far
            const int64_t N = limits.max_points / sensors;
            forget();
            for (int64_t k = 0; k < N * sensors; k++) {
                const int64_t turn = k % N * sensors + k / N, all = N * sensors;  // each sensor's reach over the window
                const int64_t cell = all < cells() ? turn * cells() / all : turn % cells();
                points[3 * k] = scale * float((double(cell / sizes.W - sizes.H / 2) + 0.5) * size);
                points[3 * k + 1] = scale * float((double(cell % sizes.W - sizes.W / 2) + 0.5) * size);
                points[3 * k + 2] = -1 + 0.01f * float(k % 7);
            }
            const torchelev_input input{sensors, N,   points.data(),   poses.data(),      T,
                                        nullptr, 0.1, variance.data(), covariances.data()};
            run_update(input);
        }
    settings = usual;
}

// Updates ------------------------------------------------------------------------------------------------------------

void torchelev_map::check(const torchelev_input& input) const {
    const int64_t S = input.num_sensors, N = input.num_points;
    REQUIRE(S >= 1 && S <= limits.max_sensors, "input.num_sensors",
            "must be from 1 to " + std::to_string(limits.max_sensors), std::to_string(S),
            "create the map with larger limits");
    REQUIRE(N >= 0 && N <= limits.max_points / S, "input.num_points",
            "must be from 0 to " + std::to_string(limits.max_points / S) + " of each sensor", std::to_string(N),
            "create the map with larger limits");
    REQUIRE(input.points || N == 0, "input.points", "must be given", "null", "give (S, N, 3) floats");
    require_poses("T_map_sensor", input.T_map_sensor, S);
    if (input.T_map_base) require_poses("T_map_base", input.T_map_base, 1);
    const std::vector<std::string>& links = cfg.body.links;
    if (links.empty()) {
        REQUIRE(!input.T_base_links, "T_base_links", "must be left out, as sensor.body has no links", "poses",
                "give sensor.body=RobotBody(...), or leave it out");
    } else {
        REQUIRE(input.T_base_links, "T_base_links",
                "must be given: the poses of " + std::to_string(links.size()) + " links", "null",
                "compute them from the joint angles");
        REQUIRE(input.T_map_base, "T_map_base", "is required to pose the links of sensor.body", "None",
                "give it, or sensor.body=None");
        require_poses("T_base_links", input.T_base_links, int64_t(links.size()));
    }
    REQUIRE(std::isfinite(input.dt) && input.dt >= 0, "dt", "must be finite and not negative", repr(input.dt),
            "give the seconds since the last update");
}

void torchelev_map::update(const torchelev_input& input) {
    check(input);
    if (input.pose_covariance) require_covariances(input.pose_covariance, input.num_sensors);
    const double last_correction = *state.statistics.drift_correction;
    run_update(input);
    history.add(input, input.T_base_links ? on_robot.data() : nullptr, last_correction);
}

const Measurement& torchelev_map::measure_again(const PastUpdate& past) {
    Sizes size = sizes;
    size.S = past.sensors, size.N = past.points, size.M = size.S * size.N, size.K = 0;
    float dt = past.dt;
    Inputs inputs{};
    inputs.points = past.xyz.data(), inputs.T_map_sensor = past.poses.data(), inputs.dt = &dt;
    inputs.T_map_base = past.has_base ? const_cast<double*>(past.base) : nullptr;
    inputs.variance = past.has_variance ? past.variance.data() : nullptr;
    inputs.own = past.has_own ? past.own.data() : nullptr;
    Update one{settings, size, state, inputs, own.measurement, own.memory, limits.num_threads};
    run_measure(one);
    return own.measurement;
}

void torchelev_map::move(const double* T_map_base) {
    require_poses("T_map_base", T_map_base, 1);
    const torchelev_input input{1, 0, nullptr, T_map_base, T_map_base, nullptr, 0, nullptr, nullptr};
    const Stage stages[] = {run_measure, run_recenter};
    run(input, stages, std::size(stages));
    if (levels) levels->follow(state);
}

// Mark the points on the robot's links: `find_own` of measure/stage.py.
void torchelev_map::find_own(const torchelev_input& input) {
    const robot_body::Body body = cfg.body.packed();
    for (int64_t k = 0; k < input.num_sensors; k++) {
        const int64_t first = k * input.num_points;
        posed.pose(body, input.T_map_sensor + 16 * k, input.T_map_base, input.T_base_links);
        posed.find(input.points + 3 * first, input.num_points, body.depth_tolerance, &on_robot[first]);
    }
}

void torchelev_map::set_sizes(const torchelev_input& input) {
    sizes.K = input.T_base_links ? int64_t(cfg.body.links.size()) : 0;
    sizes.S = input.num_sensors, sizes.N = input.num_points, sizes.M = sizes.S * sizes.N;
    sizes.P = sizes.S > 1 ? sizes.S : 0, sizes.L = levels ? levels->number() : 0;
}

// The input as stages read it; what the input gives in another type is copied into the map.
Inputs torchelev_map::inputs_of(const torchelev_input& input) {
    Inputs inputs{};
    inputs.points = const_cast<float*>(input.points), inputs.variance = const_cast<float*>(input.variance);
    inputs.T_map_sensor = const_cast<double*>(input.T_map_sensor);
    inputs.T_map_base = const_cast<double*>(input.T_map_base);
    dt = float(input.dt), inputs.dt = &dt;
    if (input.pose_covariance) {
        std::copy_n(input.pose_covariance, 36 * input.num_sensors, covariance.begin());
        inputs.pose_covariance = covariance.data();
    }
    if (input.T_base_links) {
        find_own(input);
        inputs.own = on_robot.data(), inputs.T_base_links = const_cast<double*>(input.T_base_links);
    }
    return inputs;
}

void torchelev_map::run(const torchelev_input& input, const Stage* stages, int64_t number) {
    set_sizes(input);
    Update one{settings, sizes, state, inputs_of(input), own.measurement, own.memory, limits.num_threads};
    if (levels) one.levels = levels->tensors();
    filters.forget();
    run_stages(one, stages, number);
}

void torchelev_map::run_update(const torchelev_input& input) {
    if (levels) run(input, ORDER_WITH_LEVELS, std::size(ORDER_WITH_LEVELS));
    else run(input, ORDER, std::size(ORDER));
}

// For tests, which compare them with Python's.
extern "C" const void* settings_of_map(const torchelev_map* map) { return &map->settings; }
