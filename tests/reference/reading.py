"""Reading layers, and the ground below feet."""

import math

import numpy as np

from tests.reference.places import cell_of


def sample(values, known, x, y, corner, resolution, mode):
    """The value of a layer at a position, and whether it is valid (then bilinear neighbours weigh at least a half)."""
    if mode == "nearest":
        cell = cell_of(x, y, corner, resolution, values.shape)
        return (values[cell], True) if cell is not None and known[cell] else (0.0, False)
    u, v = x / resolution - corner[0] - 0.5, y / resolution - corner[1] - 0.5
    total = weighted = 0.0
    for i in (math.floor(u), math.floor(u) + 1):
        for j in (math.floor(v), math.floor(v) + 1):
            if 0 <= i < values.shape[0] and 0 <= j < values.shape[1] and known[i, j]:
                weight = (1 - abs(u - i)) * (1 - abs(v - j))
                total, weighted = total + weight, weighted + weight * values[i, j]
    return (weighted / total, True) if total >= 0.5 else (0.0, False)


def nearest_foot(x, y, feet):
    """The height of the foot nearest to a position."""
    return min(feet, key=lambda f: math.hypot(f[0] - x, f[1] - y))[2]


def feet_plane(x, y, feet):
    """The height at a position of the least-squares plane through the feet."""
    A = np.column_stack([feet[:, :2], np.ones(len(feet))])
    return float(np.array([x, y, 1.0]) @ np.linalg.lstsq(A, feet[:, 2], rcond=None)[0])
