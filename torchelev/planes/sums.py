"""Sums over the regions of one map, on the host, and the planes that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray


class Surface(NamedTuple):
    """The cells of one map as flat arrays (P,) of H + 1 rows of W + 1: the last row and column are no cells.

    So no neighbour of a cell lies on the other side of the map, and no run of cells goes on in the next row.
    """

    shape: tuple[int, int]  #: H, W
    known: Bool[ndarray, "P"]  #: the cell has a height
    x: Float[ndarray, "P"]  #: [m] from the map's middle
    y: Float[ndarray, "P"]  #: [m] of the cell's centre
    z: Float[ndarray, "P"]  #: [m] from the map's mean; 0 where unknown
    gradient_x: Float[ndarray, "P"]  #: [m/m] of the window's plane
    gradient_y: Float[ndarray, "P"]  #: dz/dy
    before: Float[ndarray, "5 P"]  #: running sums of z, y z, z z and the gradients
    resolution: float  #: [m]
    radius: int  #: [cells] of the windows

    @property
    def weight(self) -> float:
        """The sum of squares of the cells of one window around its middle, along x [m^2]."""
        side = 2 * self.radius + 1
        return side**2 * (side**2 - 1) / 12 * self.resolution**2


def rimmed(values: ndarray, fill: float) -> ndarray:
    """Put a row and a column behind the last ones."""
    return np.pad(values, ((0, 1), (0, 1)), constant_values=fill)


def make_surface(
    known: Bool[ndarray, "H W"],
    height: Float[ndarray, "H W"],
    gradient_x: Float[ndarray, "H W"],
    gradient_y: Float[ndarray, "H W"],
    resolution: float,
    radius: int,
) -> Surface:
    """Lay out one map; `height` [m] from its mean."""
    H, W = known.shape
    x = np.repeat((np.arange(H + 1) + 0.5 - H / 2) * resolution, W + 1)
    y = np.tile((np.arange(W + 1) + 0.5 - W / 2) * resolution, H + 1)
    z, gx, gy = (rimmed(np.where(known, v, 0.0), 0.0).ravel() for v in (height, gradient_x, gradient_y))
    before = running_sums([z, y * z, z * z, gx, gy], W)
    return Surface((H, W), rimmed(known, False).ravel(), x, y, z, gx, gy, before, resolution, radius)


def running_sums(values: Sequence[Float[ndarray, "P"]], W: int) -> Float[ndarray, "M P"]:
    """Return for each cell the sums of M values over the cells before it in its row."""
    rows = np.stack(values).reshape(len(values), -1, W + 1)
    sums = np.zeros_like(rows)
    np.cumsum(rows[:, :, :-1], axis=2, out=sums[:, :, 1:])
    return sums.reshape(len(values), -1)


class Runs(NamedTuple):
    """Neighbouring cells of a row that have the same region."""

    start: Int[ndarray, "R"]  #: first cell of each run
    end: Int[ndarray, "R"]  #: the cell after the last
    region: Int[ndarray, "R"]  #: region of each run


def find_runs(labels: Int[ndarray, "P"]) -> Runs:
    """Return the runs of cells that have a label; the rim has none."""
    change = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    start = np.concatenate([[0], change])
    end = np.concatenate([change, [labels.size]])
    found = labels[start] >= 0
    return Runs(start[found], end[found], labels[start[found]])


def region_sums(before: Float[ndarray, "M P"], runs: Runs, number: int) -> Float[ndarray, "M number"]:
    """Sum M values over the cells of each region, run by run."""
    return np.stack([np.bincount(runs.region, values, number) for values in _run_sums(before, runs)])


def region_moments(surface: Surface, runs: Runs, number: int) -> Float[ndarray, "12 number"]:
    """Sum 1, x, y, z, xx, xy, yy, xz, yz, zz and the gradients over the cells of each region."""
    z, yz, zz, gx, gy = _run_sums(surface.before, runs)
    n = (runs.end - runs.start).astype(np.float64)
    x, y = surface.x[runs.start], (surface.y[runs.start] + surface.y[runs.end - 1]) / 2
    yy = n * (y * y + (n * n - 1) / 12 * surface.resolution**2)  # of n places in a row
    each = (n, n * x, n * y, z, n * x * x, n * x * y, yy, x * z, yz, zz, gx, gy)
    return np.stack([np.bincount(runs.region, values, number) for values in each])


def _run_sums(before: Float[ndarray, "M P"], runs: Runs) -> Float[ndarray, "M R"]:
    return np.take(before, runs.end, 1) - np.take(before, runs.start, 1)


class RegionPlanes(NamedTuple):
    """The planes z = z0 + g_x (x - x0) + g_y (y - y0) of K regions, each (K,) float64."""

    number: ndarray  #: of cells
    x0: ndarray  #: [m] the cells' mean
    y0: ndarray  #: [m] of the centroid
    z0: ndarray  #: [m] of the centroid
    gradient_x: ndarray  #: [m/m]
    gradient_y: ndarray  #: dz/dy
    roughness: ndarray  #: [m] root mean square distance of the cells
    extent: ndarray  #: [m^2] mean square distance of the cells from their mean, in x and y

    def at(self, label: ndarray) -> RegionPlanes:
        """Return some of the planes."""
        return RegionPlanes(*(values[label] for values in self))

    def forms(self) -> Float[ndarray, "K 4"]:
        """Return the factors of x, y, z and 1 in the distance above each plane [m]."""
        scale = 1 / np.sqrt(1 + self.gradient_x**2 + self.gradient_y**2)
        offset = self.z0 - self.gradient_x * self.x0 - self.gradient_y * self.y0
        return np.stack([-self.gradient_x, -self.gradient_y, np.ones_like(scale), -offset], 1) * scale[:, None]


def distances(surface: Surface, cell: Int[ndarray, "N"], form: Float[ndarray, "N 4"]) -> Float[ndarray, "N"]:
    """Return how far each cell lies above its plane, along the normal [m]."""
    a, b, c, d = form.T
    return a * surface.x[cell] + b * surface.y[cell] + c * surface.z[cell] + d


def fit_planes(sums: Float[ndarray, "12 K"], prior: tuple[ndarray, ndarray] | None, weight: float) -> RegionPlanes:
    """Fit a plane to the cells of each region by least squares, from their sums.

    The gradients of `prior` (K,) each, by default the mean of the cells' windows, count as `weight` [m^2]: as much as
    one window. They decide where a region is a few cells or a line, and vanish beside a region of many windows:
    (C + w I) g = c + w g_prior.
    """
    n, x, y, z, xx, xy, yy, xz, yz, zz, gx, gy = sums
    share = 1 / n.clip(min=1)
    x0, y0, z0 = x * share, y * share, z * share
    uu, uv, vv = xx - x * x0, xy - x * y0, yy - y * y0
    uh, vh, hh = xz - x * z0, yz - y * z0, zz - z * z0
    prior_x, prior_y = (gx * share, gy * share) if prior is None else prior
    a, b = uu + weight, vv + weight
    p, q = uh + weight * prior_x, vh + weight * prior_y
    det = a * b - uv * uv
    gx, gy = (b * p - uv * q) / det, (a * q - uv * p) / det
    square = hh - 2 * (gx * uh + gy * vh) + gx * gx * uu + 2 * gx * gy * uv + gy * gy * vv
    roughness = np.sqrt(square.clip(min=0) * share / (1 + gx * gx + gy * gy))
    return RegionPlanes(n, x0, y0, z0, gx, gy, roughness, (uu + vv) * share)
