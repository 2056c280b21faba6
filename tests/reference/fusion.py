"""The height update of a cell."""

import math

from tests.reference.places import cell_of, center_of


def kalman(h, variance, points):
    """The paper's equations (1) and (2), point (p_z, sigma_p^2) after point."""
    for z, point_variance in points:
        h = (point_variance * h + variance * z) / (variance + point_variance)
        variance = variance * point_variance / (variance + point_variance)
    return h, variance


def passed_center(x, y, origin, corner, resolution, shape):
    """Whether a point's ray passed over its cell's middle: the point lies within 45 degrees of straight behind it."""
    cx, cy = center_of(*cell_of(x, y, corner, resolution, shape), corner, resolution)
    dx, dy, rx, ry = x - cx, y - cy, x - origin[0], y - origin[1]
    return dx * rx + dy * ry > abs(dx * ry - dy * rx)


def agrees(p, height, variance, relief, gate):
    """|z - h| <= gate * sqrt(sigma_h^2 + sigma_p^2 + relief^2)."""
    return abs(p["z"] - height) <= gate * math.sqrt(variance + p["variance"] + relief**2)


def weighted_mean(points, value=lambda p: p["z"], weight=lambda p: 1.0):
    """The mean over points of weight 1 / sigma_p^2, times `weight`."""
    weights = [weight(p) / p["variance"] for p in points]
    return sum(w * value(p) for w, p in zip(weights, points, strict=True)) / sum(weights)


def consensus(points, relief, rounds=2):
    """A robust mean: weights 1 / (1 + r^2 / sigma^2)^2 of the residuals r, from the mean on."""
    height = weighted_mean(points)
    for _ in range(rounds):
        height = weighted_mean(
            points,
            weight=lambda p, h=height: (1 + (p["z"] - h) ** 2 / (p["variance"] + relief**2)) ** -2,
        )
    return height


def extreme(points, side, edges, relief, rounds):
    """The top (+1) or bottom (-1) of the points: the mean of those beyond the mean, repeated while enough are there."""
    level = weighted_mean(points)
    for _ in range(rounds):
        noises = [math.sqrt(p["variance"] + relief**2) for p in points]
        beyond = [p for p, n in zip(points, noises, strict=True) if side * (p["z"] - level) >= -edges["margin"] * n]
        further = weighted_mean(beyond)
        if sum(side * (p["z"] - further) >= -n for p, n in zip(points, noises, strict=True)) < edges["min_extreme"]:
            break
        level = further
    return level


def side_of_step(points, edges, relief, shown):
    """+1 and the top's height, or -1 and the ground's, of a cell that holds a step.

    The ground wins where rays passed the centre and hit low, if a neighbouring cell shows the top: by the mean height
    of its points, of which `shown[0]` is the highest, or behind it by its height in the map, `shown[1]` by (i, j).
    """
    mean, top = weighted_mean(points), extreme(points, 1, edges, relief, edges["refinements"])
    low = [p for p in points if p["z"] < mean]
    passed = sum(p["beyond"] for p in low) > edges["min_passed"] * len(low)
    rx, ry = (sum(p["ray"][axis] for p in points) for axis in (0, 1))
    angles = {(i, j): math.degrees(math.atan2(i * ry - j * rx, i * rx + j * ry)) for i, j in shown[1]}
    behind = [height for place, height in shown[1].items() if abs(angles[place]) < 50]
    if passed and (shown[0] >= (mean + top) / 2 or max(behind, default=-math.inf) >= top - relief):
        return -1, extreme(points, -1, edges, relief, rounds=2)
    return 1, top


def scan_height(cell, points, relief, shown, *, gate, max_gate_std, edges):
    """What a scan says of a cell: its height, the points kept, how many were ignored, and how many speak for the cell.

    Points on the face of a wall speak for its top; whoever sees less of a face has nothing against a settled top.
    """
    gate_variance = min(cell["variance"], max_gate_std**2)
    near = [cell["known"] and agrees(p, cell["elevation"], gate_variance, relief, gate) for p in points]
    if 2 * sum(near) >= len(points):
        guess = cell["elevation"]
    else:
        guess, gate_variance = consensus(points, relief), 0.0
    side = margin = 0
    if edges is not None:
        margin = edges["margin"]
        sigma2 = [p["variance"] + relief**2 + gate_variance for p in points]
        misfit = sum(min(1.0, (p["z"] - guess) ** 2 / (gate**2 * s)) for p, s in zip(points, sigma2, strict=True))
        if len(points) >= edges["min_points"] and misfit >= edges["min_share"] * len(points):
            side, guess = side_of_step(points, edges, relief, shown)
    wrong = [side * (p["z"] - guess) < -margin * math.sqrt(p["variance"] + relief**2) for p in points]
    kept = [p for p, w in zip(points, wrong, strict=True) if not w and agrees(p, guess, gate_variance, relief, gate)]
    height = weighted_mean(kept) if kept else guess
    for_cell = sum(n and not w for n, w in zip(near, wrong, strict=True))
    if side > 0 and height < cell["elevation"] and cell["support"] >= edges["min_settled"]:
        for_cell = len(kept) + sum(wrong)
    above = cell["known"] and 2 * sum(near) < len(points) and guess > cell["elevation"]
    return height, kept, sum(wrong), for_cell, guess if above else None


def challenge(cell, number, guess, sigma2, gate, challengers, min_above, max_above_per_scan):
    """The challenger and its support after a scan of so many points around `guess`, None if not above the elevation.

    Four `challengers` or more in the 3 x 3 window, at whatever heights, are one obstacle's.
    """
    challenger, support, votes = cell["challenger"], cell["challenger_support"], min(number, max_above_per_scan)
    if guess is None:
        return challenger, max(support - votes, 0.0)
    if support > 0 and abs(guess - challenger) <= gate * math.sqrt(sigma2):
        return challenger, support + votes
    if challengers >= 4:
        return challenger if 0 < support and guess > challenger else guess, support + votes
    if support > 0 and guess > challenger:
        return challenger, support
    return guess, votes


def fuse_cell(
    cell,
    points,
    resolution,
    *,
    gate,
    max_gate_std,
    relief,
    scan_variance_floor,
    outlier_variance,
    max_support,
    min_above,
    max_above_per_scan,
    max_variance,
    edges,
    shown=(-math.inf, {}),
    challengers=0,
    settled=-math.inf,
):
    """One cell and the points of one scan: the cell after it, and the numbers of points used and ignored at a step.

    `cell` has elevation, variance, known, support, challenger, challenger_support and time;
    each point z, variance, ray, beyond. `relief` counts cells,
    `shown` are the highest mean height of the points in the eight cells around, and the heights of those cells,
    `challengers` how many there are in the 3 x 3 window, and `settled` its highest elevation of at least half of
    `max_support`.
    """
    after, relief = dict(cell), relief * resolution
    after["variance"] = min(cell["variance"], max_variance) if cell["known"] else cell["variance"]
    if not points:
        return after, 0, 0
    settings = dict(gate=gate, max_gate_std=max_gate_std, edges=edges)
    height, kept, ignored, for_cell, guess = scan_height(cell, points, relief, shown, **settings)
    R = max(1 / sum(1 / p["variance"] for p in kept), scan_variance_floor) if kept else 1e12
    gate_variance = min(cell["variance"], max_gate_std**2)
    of_all = max(1 / sum(1 / p["variance"] for p in points), scan_variance_floor)
    sigma2 = gate_variance + of_all + relief**2
    if guess is not None and settled >= guess - gate * math.sqrt(sigma2):
        guess = None  # the edge of a step that is known
    challenger, votes = challenge(cell, len(points), guess, sigma2, gate, challengers, min_above, max_above_per_scan)
    risen = guess is not None and votes >= min_above
    after |= dict(challenger=challenger, challenger_support=min(votes, min_above))
    if not kept:
        return after, 0, ignored
    distance = abs(height - cell["elevation"])
    agree = cell["known"] and distance <= gate * math.sqrt(gate_variance + R + relief**2)
    votes = len(kept) + ignored
    margin = 2 * votes - len(points)  # votes for the height, less votes against it
    support = cell["support"] + (margin if agree else for_cell - votes)
    if agree:
        h, variance = kalman(cell["elevation"], cell["variance"], [(height, R)])
        after |= dict(elevation=h, variance=min(variance, max_variance), time=0.0)
    elif not cell["known"] or support < 0 or risen:
        after |= dict(elevation=height, variance=min(R, max_variance), known=True, time=0.0)
        after["challenger_support"] = 0.0
        support = -support if cell["known"] and not risen else margin
    else:
        after["variance"] = min(cell["variance"] + outlier_variance * len(kept), max_variance)
        return after | dict(support=min(max(support, 0), max_support)), 0, ignored
    return after | dict(support=min(max(support, 0), max_support)), len(kept), ignored
