// What the points of a cell agree on, and what the scan measures there: consensus.py and cell_measurement.py.
//
// `Points` are those of a cell, of a cell by several threads, or of a vector of cells: its V is the type of their
// numbers, `each` calls a function on points, and `add_up` completes sums over them.
#pragma once

#include "stages/fusion/equation.h"

namespace fusion {

// Compare the points of a cell with its elevation: `estimate_consensus` and `compare_with_prior`.
template <class Points, class V = typename Points::V>
INLINE Consensus<V> estimate_consensus(const Points& points, const Prior<V>& prior, const FusionSettings& s) {
    V agreeing{}, misfit{}, weight{}, moment{}, shared{};
    const V gate_at = gate_variance(prior.variance, s);
    points.each([&](const Point<V>& q) {
        agreeing += number_if<V>(agrees(q, prior.elevation, gate_at, s));
        misfit += misfit_of(q, prior.elevation, gate_at, s);
        weight += q.weight, moment += q.weight * q.z, shared += q.weight * q.shared;
    });
    points.add_up(agreeing, misfit, weight, moment, shared);
    const Flag<V> trusted = trust_majority(points.number, agreeing, prior.known);
    const Flag<V> is_step = trusted & has_step(points.number, misfit, s);
    return {points.number, ratio(moment, weight), variance_of_mean(weight, shared, s), trusted, is_step};
}

// The mean of z - height, points far from zero reduced in weight: `reduced_mean`.
template <class Points, class V = typename Points::V> INLINE V reduced_mean(const Points& points, V height) {
    V moment{}, total{};
    points.each([&](const Point<V>& q) {
        const V residual = q.z - height, reduced = reduced_weight(q, residual);
        moment += reduced * residual, total += reduced;
    });
    points.add_up(moment, total);
    return ratio(moment, total);
}

// The robust mean [m] above the mean: `robust_mean`.
template <class Points, class V = typename Points::V> INLINE V robust_mean(const Points& points, V mean) {
    const V height = reduced_mean(points, mean);
    return height + reduced_mean(points, mean + height);
}

// The height [m] of a contested cell, as far as it holds no step, and whether it does: `resolve_contested`.
template <class V> struct Resolved {
    V height;
    Flag<V> is_step;
};

template <class Points, class V = typename Points::V>
INLINE Resolved<V> resolve_contested(const Points& points, const Consensus<V>& consensus, const FusionSettings& s) {
    const V settled = robust_mean(points, consensus.mean);
    V misfit{};
    points.each([&](const Point<V>& q) { misfit += misfit_of(q, consensus.mean + settled, splat<V>(0), s); });
    points.add_up(misfit);
    return {consensus.mean + settled, Flag<V>(consensus.is_step | has_step(points.number, misfit, s))};
}

// The height [m] that counts in a cell, as far as it holds no step, and whether it does: `estimate_consensus`. A single
// point is its cell's robust mean.
template <class Points, class V = typename Points::V>
INLINE Resolved<V> settle_height(const Points& points, const Prior<V>& prior, const Consensus<V>& consensus,
                                 const FusionSettings& s) {
    const Flag<V> contested = (negated(consensus.trusted) & (points.number > 1)) | consensus.is_step;
    const V height = pick(consensus.trusted, prior.elevation, consensus.mean);
    if (!any(contested)) return {height, Flag<V>{}};
    const Resolved<V> resolved = resolve_contested(points, consensus, s);
    return {pick(contested, resolved.height, height), Flag<V>(contested & resolved.is_step)};
}

// Average the points within the gate around the consensus and on its side: `measure_cells` and `choose_points`.
template <class Points, class V = typename Points::V>
INLINE Measured<V> measure_cell(const Points& points, const Prior<V>& prior, V height, Flag<V> trusted, V side,
                                const FusionSettings& s) {
    const V gate_at = gate_variance(prior.variance, s), gate = pick(trusted, gate_at, splat<V>(0));
    const bool has_sides = any(side != 0);
    V information{}, moment{}, shared{}, kept{}, ignored{}, agreeing{};
    points.each([&](const Point<V>& q) {
        const V above = q.z - height;
        Flag<V> is_kept = agrees(q, height, gate, s), is_near = agrees(q, prior.elevation, gate_at, s);
        if (has_sides) {
            const Flag<V> ignores = q.used & (side * above < -s.margin * root(q.spread));
            ignored += number_if<V>(ignores), is_kept &= negated(ignores), is_near &= negated(ignores);
        }
        const V weight = pick(is_kept, q.weight, splat<V>(0));
        information += weight, moment += weight * above, shared += weight * q.shared;
        kept += number_if<V>(is_kept), agreeing += number_if<V>(is_near);
    });
    points.add_up(information, moment, shared, kept, ignored, agreeing);
    Measured<V> m{height + ratio(moment, information), variance_of_mean(information, shared, s), kept, ignored,
                  agreeing, points.number};
    m.agreeing = agreeing_points(m, prior, side, s);
    return m;
}

}  // namespace fusion
