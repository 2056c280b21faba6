// Written by `python -m torchelev.runtime.generate`.
#pragma once
#include <cstdint>

struct Sizes {
    int64_t B, H, W, S, N, K, M, P, L;
};

struct Statistics {
    int64_t* points_used;
    int64_t* rejected_invalid;
    int64_t* rejected_range;
    int64_t* rejected_body;
    int64_t* rejected_overhang;
    int64_t* rejected_outside;
    int64_t* rejected_outlier;
    int64_t* rejected_edge;
    int64_t* drift_points;
    float* drift_error;
    float* drift_correction;
    float* disagreement;
    int64_t* cleared_seen_through;
    int64_t* cleared_other_floors;
    int64_t* cells_bounded;
    Statistics at(int64_t b, const Sizes& n) const {
        Statistics one = *this;
        if (points_used) one.points_used += b * 1;
        if (rejected_invalid) one.rejected_invalid += b * 1;
        if (rejected_range) one.rejected_range += b * 1;
        if (rejected_body) one.rejected_body += b * 1;
        if (rejected_overhang) one.rejected_overhang += b * 1;
        if (rejected_outside) one.rejected_outside += b * 1;
        if (rejected_outlier) one.rejected_outlier += b * 1;
        if (rejected_edge) one.rejected_edge += b * 1;
        if (drift_points) one.drift_points += b * 1;
        if (drift_error) one.drift_error += b * 1;
        if (drift_correction) one.drift_correction += b * 1;
        if (disagreement) one.disagreement += b * 1;
        if (cleared_seen_through) one.cleared_seen_through += b * 1;
        if (cleared_other_floors) one.cleared_other_floors += b * 1;
        if (cells_bounded) one.cells_bounded += b * 1;
        return one;
    }
};

struct MapState {
    int64_t* corner;
    float* base_height;
    float* pose_covariance;
    int64_t* elapsed;
    float* elevation;
    float* variance;
    uint8_t* validity;
    float* support;
    float* challenger;
    uint8_t* challenger_support;
    float* time;
    float* upper_bound;
    uint8_t* bounded;
    float* gradient_x;
    float* gradient_y;
    uint8_t* has_normal;
    float* traversability;
    uint8_t* rated;
    Statistics statistics;
    MapState at(int64_t b, const Sizes& n) const {
        MapState one = *this;
        if (corner) one.corner += b * 2;
        if (base_height) one.base_height += b * 1;
        if (pose_covariance) one.pose_covariance += b * 3 * 3;
        if (elapsed) one.elapsed += b * 1;
        if (elevation) one.elevation += b * n.H * n.W;
        if (variance) one.variance += b * n.H * n.W;
        if (validity) one.validity += b * n.H * n.W;
        if (support) one.support += b * n.H * n.W;
        if (challenger) one.challenger += b * n.H * n.W;
        if (challenger_support) one.challenger_support += b * n.H * n.W;
        if (time) one.time += b * n.H * n.W;
        if (upper_bound) one.upper_bound += b * n.H * n.W;
        if (bounded) one.bounded += b * n.H * n.W;
        if (gradient_x) one.gradient_x += b * n.H * n.W;
        if (gradient_y) one.gradient_y += b * n.H * n.W;
        if (has_normal) one.has_normal += b * n.H * n.W;
        if (traversability) one.traversability += b * n.H * n.W;
        if (rated) one.rated += b * n.H * n.W;
        one.statistics = statistics.at(b, n);
        return one;
    }
};

struct StoredLevels {
    int64_t* corner;
    float* lower;
    float* upper;
    float* variance;
    float* support;
    float* time;
    float* free_top;
    uint8_t* is_open;
    int64_t* numbers;
    StoredLevels at(int64_t b, const Sizes& n) const {
        StoredLevels one = *this;
        if (corner) one.corner += b * 2;
        if (lower) one.lower += b * n.L * n.H * n.W;
        if (upper) one.upper += b * n.L * n.H * n.W;
        if (variance) one.variance += b * n.L * n.H * n.W;
        if (support) one.support += b * n.L * n.H * n.W;
        if (time) one.time += b * n.L * n.H * n.W;
        if (free_top) one.free_top += b * n.H * n.W;
        if (is_open) one.is_open += b * n.H * n.W;
        if (numbers) one.numbers += b * 5;
        return one;
    }
};

struct Inputs {
    float* points;
    double* T_map_sensor;
    double* T_map_base;
    float* dt;
    float* variance;
    double* T_base_links;
    uint8_t* own;
    float* pose_covariance;
    uint8_t* moving;
    uint8_t* aside;
    Inputs at(int64_t b, const Sizes& n) const {
        Inputs one = *this;
        if (points) one.points += b * n.S * n.N * 3;
        if (T_map_sensor) one.T_map_sensor += b * n.S * 4 * 4;
        if (T_map_base) one.T_map_base += b * 4 * 4;
        if (dt) one.dt += b * 1;
        if (variance) one.variance += b * n.S * n.N;
        if (T_base_links) one.T_base_links += b * n.K * 4 * 4;
        if (own) one.own += b * n.S * n.N;
        if (pose_covariance) one.pose_covariance += b * n.S * 6 * 6;
        if (moving) one.moving += b * 1;
        if (aside) one.aside += b * n.S * n.N;
        return one;
    }
};

struct MeasureSettings {
    double resolution;
    float farthest;
    float noise_factor;
    float noise_floor;
    float min_square;
    float max_square;
    float max_distance;
    int32_t has_ramp;
    float ramp_slope;
    float ramp_distance;
    float ramp_offset;
    float ramp_height;
    int32_t has_box;
    float box_lower[3];
    float box_upper[3];
};

struct RecenterSettings {
    float resolution;
};

struct AgeSettings {
    float variance_rate;
};

struct CompensateSettings {
    int32_t has_drift;
    float resolution;
    float min_traversability;
    float max_variance;
    float max_error;
    float gate_square;
    float relief_square;
    int32_t min_points;
    float max_drift;
    float gain;
    float nowhere;
};

struct DisagreementSettings {
    float resolution;
    float significant_square;
    float newest;
    float max_bias;
    int32_t min_cells;
    float least;
};

struct FusionSettings {
    float resolution;
    float relief;
    float gate;
    float max_gate_std;
    float floor;
    float outlier_variance;
    float max_support;
    float max_variance;
    int32_t min_above;
    int32_t max_above_per_scan;
    int32_t min_challengers;
    int32_t has_rays;
    int32_t has_edges;
    int32_t min_points;
    int32_t min_extreme;
    int32_t refinements;
    float min_share;
    float min_passed;
    float margin;
    float min_settled;
    int32_t many_points;
};

struct VisibilitySettings {
    int32_t has_rays;
    float resolution;
    float relief;
    float min_time;
    float min_incidence;
    float min_support;
    float gate;
    int32_t ranges;
    int32_t azimuths;
    float bins;
    int32_t levels;
    int32_t widen[16];
    int32_t horizon_ranges;
    int32_t near_cells;
    float clearance;
    float no_ray;
    float no_fall;
    float nowhere;
};

struct OverlapSettings {
    int32_t has_overlap;
    float resolution;
    float radius_square;
    float slope;
    float height;
    float base_height;
    float max_base_height;
    float stance_square;
    int32_t first_row;
    int32_t end_row;
    int32_t first_column;
    int32_t end_column;
};

struct SurfaceSettings {
    int32_t radius;
    int32_t cells;
    int32_t steps;
    float per_cell;
    float min_spread[2];
    float per_critical[3];
    float min_det;
    float min_trace;
    float nowhere;
    int32_t tile_memory;
};

struct LevelsSettings {
    double resolution;
    float variance_rate;
    float max_variance;
    float max_support;
    float variance_floor;
    float min_gap;
    float max_step;
    float min_support;
    float least_support;
    float min_time;
    float overlap_height;
    float overlap_radius;
    int32_t by_gap;
    int32_t max_blind;
    int32_t azimuths;
    int32_t elevations;
    int32_t ranges;
};

struct Settings {
    MeasureSettings measure;
    RecenterSettings recenter;
    AgeSettings age;
    CompensateSettings compensate;
    DisagreementSettings disagreement;
    FusionSettings fusion;
    VisibilitySettings visibility;
    OverlapSettings overlap;
    SurfaceSettings surface;
    LevelsSettings levels;
};
