"""Maps whose windows are filled by hand, so that tests know what a site should hold."""

import numpy as np
import torch

from tests.helpers import small_map


def ground(x, y):
    """Smooth ground [m]."""
    return 0.3 * torch.sin(0.3 * x) * torch.cos(0.2 * y) + 0.05 * x


def fill(emap, corners, heights=ground, *, std=0.01, offsets=None, noise=0.0, known=1.0, seed=0):
    """Move the windows to these corners, and let them know the ground as it is there, each above it by its offset."""
    generator = torch.Generator().manual_seed(seed)
    H, W = emap.elevation.shape[1:]
    state = emap.state
    emap.corner.copy_(torch.as_tensor(corners))
    xy = emap.cell_centers()
    z = heights(xy[..., 0], xy[..., 1])
    gx, gy = ((heights(xy[..., 0] + dx, xy[..., 1] + dy) - z) / 1e-4 for dx, dy in ((1e-4, 0.0), (0.0, 1e-4)))
    offsets = torch.zeros(len(z)) if offsets is None else torch.as_tensor(offsets)
    noisy = z + offsets[:, None, None] + noise * torch.randn(z.shape, generator=generator)
    state.validity.copy_(torch.rand(z.shape, generator=generator) < known)
    state.elevation.copy_(torch.where(state.validity, noisy, 0.0))
    state.variance.copy_(torch.where(state.validity, std**2, 1.0))
    state.time.zero_()
    state.gradient_x.copy_(gx)
    state.gradient_y.copy_(gy)
    state.has_normal.copy_(state.validity)
    return emap


def live(emap, seconds):
    """Let time pass for a map that measures nothing."""
    state = emap.state
    state.elapsed.add_(round(seconds * 1e9))
    state.time.add_(seconds)
    state.variance.add_(emap.cfg.aging.variance_rate * seconds)


def robots(corners, cells=(40, 36), **known):
    """A map with a window at each corner, which knows the ground there."""
    return fill(small_map(len(corners), cells), corners, **known)


def known_cells(site, layer="elevation", margin=0):
    """Cell numbers (x, y) -> value of everything that a site knows."""
    x_min, x_max, y_min, y_max = site.extent
    window = site.window(((x_min + x_max) / 2, (y_min + y_max) / 2), x_max - x_min, y_max - y_min, [layer])
    values = window.layers[layer]
    first = np.round(np.array([x_min, y_min]) / site.resolution).astype(int)
    i, j = np.nonzero(np.isfinite(values))
    return {(int(a + first[0]), int(b + first[1])): float(values[a, b]) for a, b in zip(i, j, strict=True)}


def limits(site, layer):
    """The lowest and the highest value of a layer."""
    values = known_cells(site, layer).values()
    return [min(values), max(values)]
