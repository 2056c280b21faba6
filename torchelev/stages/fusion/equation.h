// The height update of a cell, with the names of points.py, consensus.py, edges.py, challenge.py, cell_measurement.py,
// vote.py and update.py. V is a float, or a vector with a number for each of several cells.
#pragma once

#include "kernels/scalar.h"

namespace fusion {

constexpr float NO_HEIGHT = -1e30f;       // [m] below all heights
constexpr float NONE = -3e38f;            // [m] below NO_HEIGHT: of no points
constexpr float TINY = 1.17549435e-38f;   // the smallest normal number
constexpr float COSINE = 0.642787609687f;  // of 50 degrees: `lie_behind`

constexpr int TRUSTED = 1, STEP = 2, CHALLENGED = 4, TOP = 8, GROUND = 16, WON = 32;  // bits of a cell's marks

template <class V> using Flag = decltype(V{} < V{});  // bool, or a vector of -1 and 0
template <class F> INLINE F negated(F flag) { return flag == F{}; }
template <class V> INLINE V number_if(Flag<V> flag) { return pick(flag, splat<V>(1), splat<V>(0)); }
template <class V> INLINE V ratio(V numerator, V denominator) { return numerator / larger(denominator, splat<V>(TINY)); }

// A point of a cell: `ScanPoints`. Not used: the cell has fewer points than others beside it in a vector.
template <class V> struct Point {
    V z, spread, weight, shared;  // [m], [m^2], 1 / sigma_p^2, [m^2]
    Flag<V> used;
};

// What a map holds of a cell before the scan: `Prior`.
template <class V> struct Prior {
    V elevation, variance, support;
    Flag<V> known;
};

// `gather_points`.
template <class V> INLINE Point<V> make_point(V z, V noise, V shared, Flag<V> used, const FusionSettings& s) {
    return {z, noise + square(s.relief) + shared, pick(used, 1 / noise, splat<V>(0)), shared, used};
}

// Variance [m^2] that the pose adds to a point's height, less what the map's heights share: `relative_variance`.
INLINE float relative_variance(float noise, float of_pose, float of_map) {
    return larger(noise + of_pose - noise - of_map, 0.0f);
}

// Whether the ray of a point (x, y) [m] passed over the middle of the cell before it hit: `passed_center`.
INLINE bool passed_center(float x, float y, float ray_x, float ray_y, float resolution) {
    const float from_x = x - (floor_of(x / resolution) + 0.5f) * resolution;
    const float from_y = y - (floor_of(y / resolution) + 0.5f) * resolution;
    return from_x * ray_x + from_y * ray_y > absolute(from_x * ray_y - from_y * ray_x);
}

// The variance [m^2] that an elevation widens its cell's gate by: `gate_variance`.
template <class V> INLINE V gate_variance(V variance, const FusionSettings& s) {
    return smaller(variance, splat<V>(square(s.max_gate_std)));
}

// |z - h| <= gate * sqrt(sigma_h^2 + sigma_p^2): `agrees`.
template <class V> INLINE Flag<V> agrees(const Point<V>& q, V height, V variance, const FusionSettings& s) {
    return q.used & (square(q.z - height) <= square(s.gate) * (q.spread + variance));
}

// Variance [m^2] of a mean: what its points do not share, and what they do; `shared` is weighted: `add_shared`.
template <class V> INLINE V variance_of_mean(V information, V shared, const FusionSettings& s) {
    return larger(1 / larger(information, splat<V>(1e-12f)), splat<V>(s.floor)) + ratio(shared, information);
}

// Whether the elevation is known and at least half of the points agree with it: `trust_majority`.
template <class V> INLINE Flag<V> trust_majority(V number, V agreeing, Flag<V> known) {
    return known & (2 * agreeing >= number);
}

// How badly a point fits a height: `misfit`.
template <class V> INLINE V misfit_of(const Point<V>& q, V height, V variance, const FusionSettings& s) {
    const V distance = square(q.z - height) / (square(s.gate) * (q.spread + variance));
    return pick(q.used, smaller(distance, splat<V>(1)), splat<V>(0));
}

// Whether a cell holds a step, by the number of its points and the sum of their misfits: `EdgeConfig.has_step`.
template <class V> INLINE Flag<V> has_step(V number, V misfit, const FusionSettings& s) {
    return (number >= (s.has_edges ? float(s.min_points) : 3e38f)) & (misfit >= s.min_share * number);
}

// The weight of a point of which the mean is `residual` [m] away: `reduced_mean`.
template <class V> INLINE V reduced_weight(const Point<V>& q, V residual) {
    return q.weight / square(1 + square(residual) / q.spread);
}

// Whether a neighbour (di, dj) lies behind a cell, seen along its rays (x, y): `lie_behind`.
INLINE bool lies_behind(float x, float y, int di, int dj) {
    return x * di + y * dj > COSINE * root(float(di * di + dj * dj)) * root(x * x + y * y);
}

// What contradicts an elevation from above: `Challenge`.
struct Challenge {
    float height;  // [m]
    int32_t support;
    bool won;
};

// What a cell's neighbours say of a challenger: `look_around`.
struct Neighbours {
    int32_t challengers;
    float settled;  // [m] highest settled elevation
};

// The scan's points of a cell against its elevation: `estimate_consensus`.
template <class V> struct Consensus {
    V number, mean, variance;  // of the points; [m], [m^2] of their mean
    Flag<V> trusted, is_step;  // most points agree with the elevation; but many do not
};

// Whether points contradict an elevation, or a challenger stands there: `estimate_consensus`.
template <class V> INLINE Flag<V> is_challenged(const Prior<V>& prior, const Consensus<V>& consensus, Flag<V> is_standing) {
    return (prior.known & negated(consensus.trusted)) | is_standing;
}

// Let points above the elevation agree with each other: `challenge_from_above`. `height` [m] is the consensus.
INLINE Challenge challenge_from_above(const Prior<float>& prior, const Challenge& before, const Neighbours& around,
                                      const Consensus<float>& consensus, float height, const FusionSettings& s) {
    const int32_t votes = int32_t(smaller(consensus.number, float(s.max_above_per_scan)));
    const float variance = gate_variance(prior.variance, s) + consensus.variance + square(s.relief);
    const float reach = s.gate * root(variance);
    const bool contradicts = prior.known && !consensus.trusted && height > prior.elevation;
    const bool above = contradicts && height - reach > around.settled;
    const bool replaced = above && (before.support == 0 || height < before.height - reach);
    const bool backed = around.challengers >= s.min_challengers;
    const bool strays = above && !replaced && !backed && height > before.height + reach;
    const int32_t kept = replaced && !backed ? 0 : before.support;
    const int32_t after = strays ? kept : kept + (above ? votes : -votes);
    const int32_t support = after < 0 ? 0 : after > s.min_above ? s.min_above : after;
    return {replaced ? height : before.height, support, above && support >= s.min_above};
}

// One height and variance for the points of a cell: `CellMeasurement`.
template <class V> struct Measured {
    V height, variance, kept, ignored, agreeing, number;
    V votes() const { return kept + ignored; }  // points on the face of a wall support its top
    V dissent() const { return number - votes(); }
};

// The points for an elevation. A scan of a wall's lower part does not contradict its top: `measure_cells`.
template <class V> INLINE V agreeing_points(const Measured<V>& m, const Prior<V>& prior, V side, const FusionSettings& s) {
    const Flag<V> is_lower_part = (side > 0) & (m.height < prior.elevation) & (prior.support >= s.min_settled);
    return pick(is_lower_part, m.votes(), m.agreeing);
}

// What becomes of a cell: `Decision`.
template <class V> struct Decision {
    Flag<V> agrees, founds, takes;
    V support;
};

// Whether the scan's height agrees with the elevation: `gate_cells`.
template <class V> INLINE Flag<V> gate_cell(const Prior<V>& prior, const Measured<V>& m, const FusionSettings& s) {
    const V variance = gate_variance(prior.variance, s) + m.variance + square(s.relief);
    const Flag<V> is_near = square(m.height - prior.elevation) <= square(s.gate) * variance;
    return prior.known & (m.kept > 0) & is_near;
}

// `decide_by_vote` and `take_heights`.
template <class V>
INLINE Decision<V> decide_by_vote(const Prior<V>& prior, const Measured<V>& m, Flag<V> won, const FusionSettings& s) {
    const Flag<V> agrees = gate_cell(prior, m, s);
    const V support = prior.support + pick(agrees, m.votes() - m.dissent(), m.agreeing - m.votes());
    const Flag<V> founds = (m.kept > 0) & negated(agrees) & (negated(prior.known) | (support < 0) | won);
    return {agrees, founds, Flag<V>(agrees | founds), support};
}

// K = sigma_m^2 / (sigma_m^2 + R), or 1 without a prior estimate: `kalman_gain`.
template <class V> INLINE V kalman_gain(V variance, V R, Flag<V> is_prior) {
    return 1 / (1 + R * ratio(number_if<V>(is_prior), variance));
}

// What a cell holds after the scan (paper, eq. 1 and 2): `update_cells`.
template <class V>
INLINE Prior<V> update_cell(const Prior<V>& prior, const Measured<V>& m, Flag<V> won, const Decision<V>& decision,
                            const FusionSettings& s) {
    const V gain = kalman_gain(prior.variance, m.variance, decision.agrees);
    const V h = prior.elevation + gain * (m.height - prior.elevation);
    const V raised = prior.variance + smaller(s.outlier_variance, s.max_variance) * m.kept;
    const V variance = smaller(pick(decision.takes, gain * m.variance, raised), splat<V>(s.max_variance));
    const V fresh = pick(prior.known & negated(won), -decision.support, m.votes() - m.dissent());
    const V support = clamp(pick(decision.founds, fresh, decision.support), 0, s.max_support);
    const Flag<V> known = prior.known | decision.takes;
    return {pick(decision.takes, h, prior.elevation), pick(known, variance, prior.variance),
            pick(m.kept > 0, support, prior.support), known};
}

}  // namespace fusion
