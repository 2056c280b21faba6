"""Ground made of known planes, on grids of any resolution: test scenes for plane segmentation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SIZE = 10.0  # [m] side of a scene
NOISE = 0.005  # [m] 1 sigma
RISE, RUN, TREADS = 0.17, 0.3, 12  # stairs: [m], [m], number of treads


def grid(resolution: float, size: float = SIZE) -> tuple[NDArray, NDArray]:
    """Return x and y (H, W) [m] of the cell centres of a square around the origin."""
    n = round(size / resolution)
    axis = (np.arange(n) + 0.5 - n / 2) * resolution
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return x, y


def noisy(z: NDArray, seed: int = 0, noise: float = NOISE) -> Tensor:
    """Return heights (H, W) [m] with white noise of 1 sigma `noise` [m] as a float32 tensor (1, H, W)."""
    z = z + np.random.default_rng(seed).normal(0, noise, z.shape)
    return torch.from_numpy(z.astype(np.float32))[None]


def stairs(resolution: float) -> NDArray:
    """Return stairs along x, 3 m wide, from a floor at x = -2 m to a landing 2.04 m higher at x = 1.6 m."""
    x, y = grid(resolution)
    tread = np.clip(np.floor((x + 2 + 1e-9) / RUN) + 1, 0, TREADS)
    return np.where(np.abs(y) < 1.5, tread * RISE, 0.0)


def ramp(x: NDArray, low: float, high: float, rise: float) -> NDArray:
    """Return a ramp that climbs by `rise` [m] from x = `low` to x = `high` [m], level before and after."""
    return np.clip((x - low) / (high - low), 0, 1) * rise


def mixed(resolution: float, seed: int = 1) -> NDArray:
    """Return a floor with a ramp of 16 degrees to a landing, a ring around a hole, and rough ground."""
    x, y = grid(resolution)
    z = np.where((y > 1) & (y < 4), ramp(x, -4, -1, 0.9) * (x < 2), 0.0)
    radius = np.hypot(x - 2, y + 2.5)
    z = np.where((radius < 1.6) & (radius > 0.6), 0.25, z)
    rough = (np.abs(x + 2.5) < 1.5) & (np.abs(y + 2.5) < 1.5)
    return np.where(rough, np.random.default_rng(seed).uniform(-0.1, 0.1, z.shape), z)


def hills(resolution: float) -> NDArray:
    """Return rolling hills with hardly a plane: slopes up to 24 degrees, radii of curvature down to 2 m."""
    x, y = grid(resolution)
    return 0.2 * np.sin(2 * np.pi * x / 4.1) * np.cos(2 * np.pi * y / 3.3) + 0.1 * np.sin(2 * np.pi * (x + y) / 5.7)


SCENES: dict[str, Callable[[float], NDArray]] = {"stairs": stairs, "mixed": mixed, "hills": hills}
