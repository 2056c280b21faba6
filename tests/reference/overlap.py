"""Overlap clearance."""

import math

import numpy as np

from tests.reference.places import center_of


def ground_below(layers, base, corner, resolution, radius, height, max_base_height):
    """Height of the ground on which the robot stands [m], the base's where none is known.

    The weighted mean of the near cells at most `max_base_height` below the base, or of all below it that were hit now:
    if the former are the smaller part of what is below, or the latter are higher by half of `height`.
    """
    hit, within, total = [], [], 0.0
    for i, j in zip(*np.nonzero(layers["validity"]), strict=True):
        x, y = center_of(i, j, corner, resolution)
        d, z = math.hypot(x - base[0], y - base[1]), layers["elevation"][i, j]
        if d > radius or z > base[2]:
            continue
        weight = 1 / (d * d + 0.25) ** 2
        total += weight
        if layers["time"][i, j] == 0:
            hit.append((weight, z))
        if z >= base[2] - max_base_height:
            within.append((weight, z))
    of_hit, of_within = (
        sum(w * z for w, z in cells) / sum(w for w, _ in cells) if cells else None for cells in (hit, within)
    )
    larger = sum(w for w, _ in within) > total / 2
    if larger and (of_hit is None or of_hit <= of_within + height / 2):
        return of_within
    return base[2] if of_hit is None else of_hit


def clear_other_floors(layers, base, corner, resolution, *, radius, height, base_height, max_base_height):
    """validity and bounded after cells near the robot and far from its height are cleared; and how many were."""
    validity, bounded, cleared = layers["validity"].copy(), layers["bounded"].copy(), 0
    ground = ground_below(layers, base, corner, resolution, radius, height, max_base_height)
    flies = ground < base[2] - max_base_height
    robot = base[2] if flies else min(base[2], ground + base_height)

    def elsewhere(z, allowance):
        too_low = z < robot - height - allowance and not flies
        return too_low or (z > robot + height + allowance and z > base[2] + allowance)

    for i, j in np.ndindex(validity.shape):
        x, y = center_of(i, j, corner, resolution)
        d = math.hypot(x - base[0], y - base[1])
        if d > radius:
            continue
        hit = layers["time"][i, j] == 0
        if validity[i, j] and elsewhere(layers["elevation"][i, j], d * height / radius if hit else 0.0):
            validity[i, j] = bounded[i, j] = False
            cleared += 1
        elif bounded[i, j] and elsewhere(layers["upper_bound"][i, j], 0.0):
            bounded[i, j] = False
    return validity, bounded, cleared
