"""Ground of known planes, 10 x 10 m at any resolution: what the tests and benchmarks of planes segment."""

import numpy as np
import torch

SIZE = 10.0  # [m]
NOISE = 0.005  # [m]
RISE, RUN, TREADS = 0.17, 0.3, 12  # [m], [m], number


def grid(resolution, size=SIZE):
    """x and y [m] of the cells' centres, (H, W) each, around the origin."""
    n = round(size / resolution)
    x = (np.arange(n) + 0.5 - n / 2) * resolution
    return np.meshgrid(x, x, indexing="ij")


def noisy(z, seed=0, noise=NOISE):
    """A tensor (1, H, W) of heights with white noise."""
    z = z + np.random.default_rng(seed).normal(0, noise, z.shape)
    return torch.from_numpy(z.astype(np.float32))[None]


def stairs(resolution):
    """Stairs up along x, 3 m wide, from a floor at x = -2 to a landing at x = 1.6, 2.04 m higher."""
    x, y = grid(resolution)
    tread = np.clip(np.floor((x + 2 + 1e-9) / RUN) + 1, 0, TREADS)
    return np.where(np.abs(y) < 1.5, tread * RISE, 0.0)


def ramp(x, low, high, rise):
    """A ramp along x from `low` to `high`, level before and after."""
    return np.clip((x - low) / (high - low), 0, 1) * rise


def mixed(resolution, seed=1):
    """A ramp of 16 degrees to a landing, a ring with a hole, and rough ground, on a floor."""
    x, y = grid(resolution)
    z = np.where((y > 1) & (y < 4), ramp(x, -4, -1, 0.9) * (x < 2), 0.0)
    radius = np.hypot(x - 2, y + 2.5)
    z = np.where((radius < 1.6) & (radius > 0.6), 0.25, z)
    rough = (np.abs(x + 2.5) < 1.5) & (np.abs(y + 2.5) < 1.5)
    return np.where(rough, np.random.default_rng(seed).uniform(-0.1, 0.1, z.shape), z)


def hills(resolution):
    """Rolling hills: nothing is planar for long. Slopes up to 24 degrees, radii of curvature down to 2 m."""
    x, y = grid(resolution)
    return 0.2 * np.sin(2 * np.pi * x / 4.1) * np.cos(2 * np.pi * y / 3.3) + 0.1 * np.sin(2 * np.pi * (x + y) / 5.7)


SCENES = {"stairs": stairs, "mixed": mixed, "hills": hills}
