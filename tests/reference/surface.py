"""Planes, steps and traversability."""

import math

import numpy as np


def window(validity, i, j, radius):
    """The known cells within `radius` cells of a cell."""
    H, W = validity.shape
    rows, columns = range(max(0, i - radius), min(H, i + radius + 1)), range(max(0, j - radius), min(W, j + radius + 1))
    return [(a, b) for a in rows for b in columns if validity[a, b]]


def fit_plane(elevation, validity, i, j, radius, resolution):
    """Least-squares plane through the known cells around a cell: does it exist, its gradient, mean squared residual.

    Cells on one line leave the gradient across it open; the shortest gradient is taken.
    """
    cells = window(validity, i, j, radius)
    if not cells:
        return False, 0.0, 0.0, 0.0
    xy = np.array([((a - i) * resolution, (b - j) * resolution) for a, b in cells])
    z = np.array([elevation[c] for c in cells])
    A, b = xy - xy.mean(0), z - z.mean()
    gradient = np.linalg.lstsq(A, b, rcond=1e-6)[0]
    return spans_plane(cells, radius), gradient[0], gradient[1], float(np.mean((b - A @ gradient) ** 2))


def spans_plane(cells, radius):
    """Do cells spread across the line that fits them best: as two full rows, and by 0.4 of a full window, or more?"""
    across = np.linalg.eigvalsh(np.cov(np.array(cells, float).T, bias=True))[0]
    full = np.mean(np.arange(-radius, radius + 1.0) ** 2)
    return across >= max(0.25, 0.16 * full) - 1e-3


def step_at(elevation, validity, i, j, radius):
    """The largest height difference between a known cell and those around it."""
    return max(abs(elevation[c] - elevation[i, j]) for c in window(validity, i, j, radius))


def traversability(elevation, validity, i, j, resolution, *, radius, critical_slope, critical_step, critical_roughness):
    """1 - max(slope / critical, step / critical, roughness / critical), not below 0; `radius` in metres.

    None where the cells of the window do not span a plane. A step is a height difference within 0.1 m and the window.
    """
    cells = max(1, round(radius / resolution))
    spans, gx, gy, residual = fit_plane(elevation, validity, i, j, cells, resolution)
    if not spans:
        return None
    step = step_at(elevation, validity, i, j, min(cells, max(1, round(0.1 / resolution))))
    slope = math.atan(math.hypot(gx, gy))
    return max(0.0, 1 - max(slope / critical_slope, step / critical_step, math.sqrt(residual) / critical_roughness))
