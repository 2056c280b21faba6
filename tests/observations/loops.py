"""Slow copies of a scan and of the rules that fill unknown cells, for one environment, from scalars."""

import math

import numpy as np

from tests import reference
from tests.helpers import rotation
from torchelev.observations.patterns import Pattern


def loop_sample(layer, known, x, y, corner, mode):
    if mode != "minimum":
        return reference.sample(layer, known, x, y, corner, 0.1, mode)
    found = []
    i, j = math.floor(x / 0.1 - 0.5) - corner[0], math.floor(y / 0.1 - 0.5) - corner[1]
    for a, b in ((i, j), (i + 1, j), (i, j + 1)):
        if 0 <= a < layer.shape[0] and 0 <= b < layer.shape[1] and known[a, b]:
            found.append(layer[a, b])
    return (min(found), True) if found else (0.0, False)


def loop_turn(point, R, alignment):
    if alignment == "world":
        return point
    if alignment == "base":
        return tuple((R @ [*point, 0.0])[:2])
    yaw = math.atan2(R[1, 0], R[0, 0])
    return tuple((rotation(yaw) @ [*point, 0.0])[:2])


def loop_inpaint(layer, known, rings):
    layer, known = np.where(known, layer, 0.0), known.copy()
    for _ in range(rings):
        before, seen = layer.copy(), known.copy()
        for i in range(layer.shape[0]):
            for j in range(layer.shape[1]):
                window = np.s_[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2]
                if not seen[i, j] and seen[window].any():
                    layer[i, j], known[i, j] = before[window][seen[window]].mean(), True
    return layer, known


def loop_levels(layer, known, u, v):
    """What a place, in cells from the corner, reads of blocks of 1, 2, 4, ... cells a side, None where nothing."""
    read = []
    while True:
        value, good = reference.sample(layer, known, u, v, (0, 0), 1.0, "bilinear")
        read.append(value if good else None)
        if max(layer.shape) == 1:
            return read
        u, v, size = u / 2, v / 2, [(n + 1) // 2 for n in layer.shape]
        blocks, some = np.zeros(size), np.zeros(size, bool)
        for i in range(size[0]):
            for j in range(size[1]):
                window = np.s_[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
                some[i, j] = known[window].any()
                blocks[i, j] = layer[window][known[window]].mean() if some[i, j] else 0.0
        layer, known = blocks, some


def loop_ground(layer, known, x, y, base, corner, half):
    """The ground at a place, continued from what is known of 0.1 m cells; None on an empty map."""
    rows, columns = (max(0, n // 2 - cells - 5) for n, cells in zip(layer.shape, half, strict=True))
    part = np.s_[rows : layer.shape[0] - rows, columns : layer.shape[1] - columns]
    layer, known, corner = layer[part], known[part], (corner[0] + rows, corner[1] + columns)
    near = loop_levels(layer, known, x / 0.1 - corner[0], y / 0.1 - corner[1])[:4]  # up to 0.8 m
    under = loop_levels(layer, known, base[0] / 0.1 - corner[0], base[1] / 0.1 - corner[1])
    under = [value for value in under if value is not None and value < base[2]]
    return next((value for value in [*near, *under] if value is not None), None)


def loop_scan(scan, emap, T, feet, b):
    """One environment's values, point by point."""
    corner, layers = emap.corner[b].tolist(), {n: v[b].numpy() for n, v in emap.state._asdict().items() if n in KEPT}
    h, known = layers["elevation"], layers["validity"]
    bound = np.where(known, h, layers["upper_bound"])
    filled = loop_inpaint(h, known, scan.inpaint_rings)
    places = []
    for middle in [T[b, :3, 3]] if feet is None else feet[b]:
        for point in scan.pattern:
            dx, dy = loop_turn(point, T[b, :3, :3].numpy(), scan.alignment)
            places.append((float(middle[0]) + dx, float(middle[1]) + dy, float(middle[2])))
    read = [loop_sample(h, known, x, y, corner, scan.mode) for x, y, _ in places]
    lowest = min((value for value, good in read if good), default=None)
    values = []
    for (x, y, z), (ground, good) in zip(places, read, strict=True):
        if not good and scan.fill == "lowest" and lowest is not None:
            ground, good = lowest, True
        if not good and scan.fill == "upper_bound":
            ground, good = loop_sample(bound, known | layers["bounded"], x, y, corner, scan.mode)
        if not good and scan.fill == "ground":
            half = Pattern(scan.pattern, scan.alignment, scan.reach).half_extent(emap.cfg.grid)
            value = loop_ground(h, known, x, y, T[b, :3, 3].tolist(), corner, half)
            ground, good = (0.0, False) if value is None else (value, True)
        if not good and scan.fill == "inpaint":
            ground, good = loop_sample(*filled, x, y, corner, scan.mode)
        value = z - ground - scan.nominal_height if good else 0.2 if isinstance(scan.fill, str) else scan.fill
        values.append(value if scan.clip is None else min(max(value, -scan.clip), scan.clip))
    return np.array(values) * scan.scale, np.array([good for _, good in read])


KEPT = ("elevation", "validity", "upper_bound", "bounded")
