// The update of one cell: stages/fusion/{consensus,challenge,cell_measurement,vote,fuse}.py.
#pragma once

#include "consensus.h"

// What maps hold of their cells before the scan.
struct Map {
    const float *elevation, *variance, *support, *challenger;
    const uint8_t *challenger_support, *known;
    const float* time;

    // What a map holds whose first cell is number k.
    Map from(int64_t k) const {
        return {elevation + k,          variance + k, support + k, challenger + k,
                challenger_support + k, known + k,    time + k};
    }
};

// What a cell holds after it.
struct Cell {
    float elevation, variance, support, challenger, time;
    uint8_t challenger_support, known;
    int64_t used, ignored;  // points
};

// The scan's points of a cell against its elevation: `estimate_consensus`.
struct Consensus {
    float number, mean, variance;
    bool trusted, is_step;
};

inline bool agrees(const Point& point, float height, float variance, const Settings& s) {
    return square(point.z - height) <= square(s.gate) * (point.spread + variance);
}

// The variance that a cell's elevation widens its gate by: `gate_variance`.
inline float gate_variance(float variance, const Settings& s) { return std::min(variance, square(s.max_gate_std)); }

inline Consensus find_consensus(const Points& p, const Map& map, int64_t slot, const Settings& s) {
    float agreeing = 0, weight = 0, moment = 0, shared = 0;
    const float gate_at = gate_variance(map.variance[slot], s);
    for (const Point& point : p) {
        agreeing += agrees(point, map.elevation[slot], gate_at, s);
        weight += point.weight, moment += point.weight * point.z, shared += point.weight * point.shared;
    }
    p.add_up(agreeing, weight, moment, shared);
    const float number = p.number;
    const bool trusted = map.known[slot] && 2 * agreeing >= number;
    const float variance = std::max(1.0f / std::max(weight, 1e-12f), s.floor) + ratio(shared, weight);
    return {number, ratio(moment, weight), variance, trusted, trusted && has_step(number, number - agreeing, s)};
}

struct Challenge {
    float height;
    int32_t support;
    bool won;
};

// Let points above the elevation agree with each other: `challenge_from_above`.
inline Challenge challenge(const Map& map, int64_t slot, const Consensus& consensus, float height, const Around& around,
                           const Settings& s) {
    const Challenge before{map.challenger[slot], map.challenger_support[slot], false};
    const bool contradicted = map.known[slot] && !consensus.trusted;
    if (!s.has_rays || !(contradicted || before.support > 0)) return before;
    int32_t challengers = 0;
    float settled = NO_HEIGHT;
    auto look = [&](int64_t other, int, int) {
        challengers += map.challenger_support[other] > 0;
        const bool is_settled = map.known[other] && map.support[other] >= 0.5f * s.max_support;
        if (is_settled) settled = std::max(settled, map.elevation[other]);
    };
    look(slot, 0, 0);
    around.each(slot, look);
    const int32_t votes = std::min(consensus.number, float(s.max_above_per_scan));
    const float variance = gate_variance(map.variance[slot], s) + consensus.variance + square(s.relief);
    const float reach = s.gate * std::sqrt(variance);
    const bool above = contradicted && height > map.elevation[slot] && height - reach > settled;
    const bool replaced = above && (before.support == 0 || height < before.height - reach);
    const bool backed = challengers >= s.min_challengers;
    const bool strays = above && !replaced && !backed && height > before.height + reach;
    const int32_t kept = replaced && !backed ? 0 : before.support;
    const int32_t after = std::clamp(strays ? kept : kept + (above ? votes : -votes), 0, s.min_above);
    return {replaced ? height : before.height, after, above && after >= s.min_above};
}

// The points within the gate, averaged: `measure_cells`.
struct Measured {
    float height, variance, kept, votes, dissent, agreeing, ignored;
};

inline Measured measure(const Points& p, const Map& map, int64_t slot, const Consensus& consensus, Side side,
                        const Settings& s) {
    const float gate_at = gate_variance(map.variance[slot], s), gate = consensus.trusted ? gate_at : 0.0f;
    float information = 0, moment = 0, shared = 0, kept = 0, ignored = 0, agreeing = 0;
    for (const Point& point : p) {
        const float above = point.z - side.height;
        if (side.side != 0 && side.side * above < -s.margin * std::sqrt(point.spread)) {
            ignored++;
            continue;
        }
        agreeing += agrees(point, map.elevation[slot], gate_at, s);
        if (!agrees(point, side.height, gate, s)) continue;
        information += point.weight, moment += point.weight * above, shared += point.weight * point.shared, kept++;
    }
    p.add_up(information, moment, shared, kept, ignored, agreeing);
    const float height = side.height + ratio(moment, information), votes = kept + ignored;
    const bool is_lower_part =
        side.side > 0 && height < map.elevation[slot] && map.support[slot] >= s.min_settled;
    const float variance = std::max(1.0f / std::max(information, 1e-12f), s.floor) + ratio(shared, information);
    return {height, variance, kept, votes, consensus.number - votes, is_lower_part ? votes : agreeing, ignored};
}

// Vote, and update the cell: `decide_by_vote` and `update_cells`.
inline Cell update(const Map& map, int64_t slot, const Measured& m, const Challenge& challenge, const Settings& s) {
    const float before = map.elevation[slot], variance = map.variance[slot];
    const bool known = map.known[slot], is_hit = m.kept > 0;
    const float innovation = m.height - before;
    const float limit = square(s.gate) * (gate_variance(variance, s) + m.variance + square(s.relief));
    const bool agrees = known && is_hit && square(innovation) <= limit;
    const float support = map.support[slot] + (agrees ? m.votes - m.dissent : m.agreeing - m.votes);
    const bool founds = is_hit && !agrees && (!known || support < 0 || challenge.won), takes = agrees || founds;
    const float gain = 1.0f / (1.0f + m.variance * ratio(agrees, variance));
    const float raised = variance + std::min(s.outlier_variance, s.max_variance) * m.kept;
    const float fresh = known && !challenge.won ? -support : m.votes - m.dissent;
    const float after = std::min(takes ? gain * m.variance : raised, s.max_variance);
    Cell cell{};
    cell.elevation = takes ? before + gain * innovation : before;
    cell.variance = known || takes ? after : 1.0f;
    cell.support = is_hit ? std::clamp(founds ? fresh : support, 0.0f, s.max_support) : map.support[slot];
    cell.challenger = challenge.height;
    cell.challenger_support = founds ? 0 : challenge.support;
    cell.known = known || takes;
    cell.time = takes ? 0.0f : map.time[slot];
    cell.used = takes ? int64_t(m.kept) : 0, cell.ignored = int64_t(m.ignored);
    return cell;
}

inline Cell update_cell(const Points& p, const Map& map, int64_t slot, const Consensus& consensus, const Around& around,
                        const Settings& s) {
    Side side{0, consensus.trusted ? map.elevation[slot] : consensus.mean};
    const bool is_contested = (!consensus.trusted && p.number > 1) || consensus.is_step;
    if (is_contested) side = resolve(p, consensus.mean, consensus.is_step, slot, around, s);
    const Challenge found = challenge(map, slot, consensus, side.height, around, s);
    return update(map, slot, measure(p, map, slot, consensus, side, s), found, s);
}
