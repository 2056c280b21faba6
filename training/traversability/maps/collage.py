"""Ground as a collage: shapes of many sizes, each at its own height, laid over each other at random.

Images made so ("dead leaves") resemble natural ones in their statistics. No kind of ground is meant: edges, steps,
trenches, walls, holes, pillars and ramps occur in all sizes and side by side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

_LAYERS = (0.1, 2.0)  # area of all shapes by that of the tile
_MAX_ASPECT = 12.0  # length of a shape by its width
_STEPS = (0.02, 1.0)  # [m] typical height of a tile's steps
_MAX_TILT = 0.5  # slope of a shape's top
_STACKED = 0.5  # share of shapes whose height counts from the ground below each place, not from one level
_SIGNS = {"up and down": 0.4, "down": 0.3, "up": 0.3}  # share of tiles by where their steps lead


class Shapes(NamedTuple):
    """The shapes of a tile."""

    most: int = 500
    largest: tuple[float, float] = (0.2, 2.5)  #: [m] half the length of a tile's largest shapes
    smallest: float = 0.05  #: [m] half the length of the smallest
    level: float = 0.5  #: share with a level top


USUAL = Shapes()


def make_collage(axis: Tensor, rng: np.random.Generator, shapes: Shapes = USUAL) -> Tensor:
    """Return the heights (N, N) [m] of a tile, whose samples lie at `axis` (N,) [m] along x and y."""
    half, spacing = float(axis.max()), float(axis[1] - axis[0])
    largest, step = _log_uniform(rng, *shapes.largest), _log_uniform(rng, *_STEPS)
    signs = {"up and down": [-1, 1], "down": [-1], "up": [1]}[str(rng.choice(list(_SIGNS), p=list(_SIGNS.values())))]
    ground = torch.zeros(len(axis), len(axis), dtype=axis.dtype)
    area_left = _log_uniform(rng, *_LAYERS) * (2 * half) ** 2
    for _ in range(shapes.most):
        length = _log_uniform(rng, min(shapes.smallest, largest), largest)  # half of it
        center, turn = rng.uniform(-half, half, 2), rng.uniform(-math.pi, math.pi)
        corners = ((center + sign * 1.5 * length + half) / spacing for sign in (-1, 1))
        first, last = (corner.clip(0, len(axis)).astype(int) for corner in corners)
        window = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
        x, y = torch.meshgrid(axis[window[0]] - center[0], axis[window[1]] - center[1], indexing="ij")
        u, v = math.cos(turn) * x + math.sin(turn) * y, math.cos(turn) * y - math.sin(turn) * x
        inside = _inside(u, v, length, rng)
        height = step * rng.exponential() * rng.choice(signs)
        tilt = 0.0 if rng.random() < shapes.level else rng.uniform(-_MAX_TILT, _MAX_TILT)
        below = ground[window]
        base = below if rng.random() < _STACKED else torch.zeros_like(below)
        ground[window] = torch.where(inside, base + height + tilt * u, below)
        area_left -= float(inside.sum()) * spacing**2
        if area_left < 0:
            break
    return ground


def _inside(u: Tensor, v: Tensor, length: float, rng: np.random.Generator) -> Tensor:
    """Return whether places are in a rectangle, an ellipse or a ring around the origin."""
    width = length / _log_uniform(rng, 1.0, _MAX_ASPECT)
    shape, hole = rng.random(), rng.uniform(0.4, 0.9)
    if shape < 0.5:
        return (u.abs() < length) & (v.abs() < width)
    distance = torch.hypot(u / length, v / width)
    return (distance < 1) & (distance > (hole if shape > 0.8 else -1.0))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))
