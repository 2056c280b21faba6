"""The presets of `HeightScan`: points, settings and noise of other simulators and papers."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Any

from torchelev.observations import patterns
from torchelev.observations.patterns import Points

PRESETS = ("isaac_lab", "mjlab", "legged_gym")  # classmethods of `HeightScan`

Settings = MappingProxyType[str, Any]  # of `ScanSettings`

ISAAC_LAB: Settings = MappingProxyType(dict(nominal_height=0.5, clip=1.0, noise=0.1, original=-math.inf))
MJLAB: Settings = MappingProxyType(dict(scale=1 / 5, noise=0.1, original=5.0, standing_height=0.5))
LEGGED_GYM: Settings = MappingProxyType(
    dict(mode="minimum", nominal_height=0.5, clip=1.0, scale=5.0, noise=0.1, noise_after_clip=True)
)

LEGGED_GYM_X = tuple(k / 10 for k in range(-8, 9))  # [m]
LEGGED_GYM_Y = tuple(k / 10 for k in range(-5, 6))  # [m]
RINGS = ((0.08, 6), (0.16, 8), (0.26, 10), (0.36, 12), (0.48, 16))  # radius [m] and points of Miki et al. 2022


def isaac_lab_points(length_x: float, length_y: float, resolution: float) -> Points:
    """Return the points (P, 2) [m] of Isaac Lab's grid: `arange(-length / 2, length / 2 + 1e-9, resolution)`."""
    return _order_by_arange(length_x, length_y, resolution, 1e-9)


def mjlab_points(length_x: float, length_y: float, resolution: float) -> Points:
    """Return the points (P, 2) [m] of mjlab's grid: `arange(-length / 2, length / 2 + resolution / 2, resolution)`."""
    return _order_by_arange(length_x, length_y, resolution, resolution * 0.5)


def _order_by_arange(length_x: float, length_y: float, resolution: float, margin: float) -> Points:
    x, y = (patterns.space_by_arange(length, resolution, margin) for length in (length_x, length_y))
    return patterns.order_x_fastest(x, y)
