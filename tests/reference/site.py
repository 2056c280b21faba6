"""Fusing the cells of a site."""


def information(height, time, rate):
    """1 / sigma^2 of a height at a later time; 0 without one. A height is a dict of h [m], v [m^2] and t [s]."""
    return 1.0 / (height["v"] + rate * (time - height["t"])) if height else 0.0


def fuse_site_cell(first, other, entries, rate, *, gate, max_gate_std, max_newer_ratio):
    """What a site's cell says after a merge, what contradicts that, and whether heights contradicted each other.

    Entries are heights with the relief [m^2] of their cell, and `contributed`, the same robot's earlier contribution.
    """
    limits = dict(rate=rate, gate=gate, max_gate_std=max_gate_std)
    fused, left, is_kept = average_site_cell(first, entries, None, **limits)
    if not left and is_kept:
        return fused, other, False
    fused, left, is_kept = average_site_cell(first, entries, surest, **limits)
    rest = left + ([] if is_kept else [{**first, "relief": 0.0, "contributed": None}])
    second, _, _ = average_site_cell(other, rest, surest, **limits, among_entries=True)
    is_new = len(left) < len(entries), bool(left)
    if second and replaces(second, fused, is_new, rate, max_newer_ratio):
        fused, second = second, fused
    return fused, second, True


def surest(heights, weights, mean):
    """The height of the most information; of several, the one nearest to the mean [mm], and then the lowest."""
    certain = [h for h, w in zip(heights, weights, strict=True) if w >= max(weights)]
    return min(certain, key=lambda h: (round(1e3 * abs(h - mean)), h))


def average_site_cell(prior, entries, choose, *, rate, gate, max_gate_std, among_entries=False):
    """The mean of what lies near the reference, the entries that do not, and whether the prior does."""
    if not entries:
        return prior, [], True
    newest = max(x["t"] for x in [*entries, prior or entries[0]])
    heights = [e["h"] for e in entries] + ([prior["h"]] if prior else [])
    weights = [information(e, newest, rate) for e in [*entries, *([prior] if prior else [])]]
    total = sum(weights)
    mean = sum(h * w for h, w in zip(heights, weights, strict=True)) / total
    eligible = weights[: len(entries)] if among_entries else weights
    reference = mean if choose is None else choose(heights[: len(eligible)], eligible, mean)

    def is_near(height, weight, relief):
        others = max(total - weight, 1e-6 * total)
        distance = (height - mean) * total / others if choose is None else height - reference
        variance = 1 / weight + 1 / (others if choose is None else max(eligible))
        return distance**2 <= gate**2 * (min(variance, max_gate_std**2) + relief)

    near = [e for e, w in zip(entries, weights, strict=False) if is_near(e["h"], w, e["relief"])]
    relief = max(e["relief"] for e in entries)
    is_kept = bool(prior) and is_near(prior["h"], weights[-1], relief)
    if not near:
        return prior, entries, is_kept or not prior
    own = information(prior, newest, rate) if is_kept else 0.0
    moment = own * (prior["h"] - reference) if is_kept else 0.0
    total = own + sum(information(e, newest, rate) for e in near)
    for e in near if is_kept else []:
        contributed = e["contributed"]
        if not contributed or (contributed["h"] - prior["h"]) ** 2 > gate**2 * (max_gate_std**2 + e["relief"]):
            continue
        new, before = information(e, newest, rate), information(contributed, newest, rate)
        total -= min(new, before)
        moment -= min(new, before) * ((e if before >= new else contributed)["h"] - reference)
    moment += sum(information(e, newest, rate) * (e["h"] - reference) for e in near)
    times = [e["t"] for e in near] + ([prior["t"]] if is_kept else [])
    left = [e for e in entries if not any(e is n for n in near)]
    return dict(h=reference + moment / total, v=1 / total, t=max(times)), left, is_kept or not prior


def replaces(other, first, is_new, rate, max_newer_ratio):
    """Whether a site is to say the other height: newer and about as sure, or as new and surer.

    Of the same time, one that holds what is merged now, `is_new` of the first and of the other, is newer.
    """
    newest = max(other["t"], first["t"])
    ratio = information(first, newest, rate) / information(other, newest, rate)
    ages = (first["t"], is_new[0]), (other["t"], is_new[1])
    if ages[0] == ages[1]:
        return ratio < 1
    return ratio < (max_newer_ratio if ages[1] > ages[0] else 1 / max_newer_ratio)
