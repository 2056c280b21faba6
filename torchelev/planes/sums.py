"""Sums over the regions of maps, on the host: run by run of each row, from cumulative sums."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Shaped
    from numpy import ndarray


class Surface(NamedTuple):
    """The cells of maps as flat arrays (P,), P = B (H + 1) (W + 1): a row and a column of padding follow each map.

    With the padding, flat index + 1 never leads to a cell of the next row, and -1 never wraps around. B maps are one
    map of B (H + 1) - 1 rows to what looks at neighbours: as the rows between them are unknown, no region crosses them.
    """

    shape: tuple[int, int]  #: B (H + 1) - 1, W
    known: Bool[ndarray, "P"]  #: the cell has a height
    x: Float[ndarray, "P"]  #: [m] from its map's centre
    y: Float[ndarray, "P"]  #: [m] from its map's centre
    z: Float[ndarray, "P"]  #: [m] from its map's mean; 0 where unknown
    gradient_x: Float[ndarray, "P"]  #: [m/m] of the window's plane
    gradient_y: Float[ndarray, "P"]  #: [m/m] of the window's plane
    before: Float[ndarray, "5 P"]  #: cumulative sums of z, y z, z z and the gradients
    resolution: float  #: [m] of a cell
    radius: int  #: [cells] of the windows
    num_maps: int = 1  #: B

    @property
    def window_moment(self) -> float:
        """The sum of squared distances [m^2] of one window's cells from its centre, along x."""
        side = 2 * self.radius + 1
        return side**2 * (side**2 - 1) / 12 * self.resolution**2


def pad_cells(values: Shaped[ndarray, "*B H W"], fill: float) -> Shaped[ndarray, "*B H+1 W+1"]:
    """Append a row and a column to each map."""
    *B, H, W = values.shape
    padded = np.full((*B, H + 1, W + 1), fill, values.dtype)
    padded[..., :H, :W] = values
    return padded


def make_surface(
    known: Bool[ndarray, "*B H W"],
    height: Float[ndarray, "*B H W"],
    gradient_x: Float[ndarray, "*B H W"],
    gradient_y: Float[ndarray, "*B H W"],
    resolution: float,
    radius: int,
) -> Surface:
    """Lay out one map, or B maps one below the other; `height` [m] from each one's mean."""
    *B, H, W = known.shape
    num_maps = math.prod(B)
    x = np.tile(np.repeat((np.arange(H + 1) + 0.5 - H / 2) * resolution, W + 1), num_maps)
    y = np.tile((np.arange(W + 1) + 0.5 - W / 2) * resolution, num_maps * (H + 1))
    z, gx, gy = (pad_cells(np.where(known, v, 0.0), 0.0).ravel() for v in (height, gradient_x, gradient_y))
    before, shape = cumulative_sums([z, y * z, z * z, gx, gy], W), (num_maps * (H + 1) - 1, W)
    return Surface(shape, pad_cells(known, False).ravel(), x, y, z, gx, gy, before, resolution, radius, num_maps)


def cumulative_sums(values: Sequence[Float[ndarray, "P"]], W: int) -> Float[ndarray, "M P"]:
    """Return for each cell the sums of M values over the cells before it in its row."""
    rows = np.stack(values).reshape(len(values), -1, W + 1)
    sums = np.zeros_like(rows)
    np.cumsum(rows[:, :, :-1], axis=2, out=sums[:, :, 1:])
    return sums.reshape(len(values), -1)


class Runs(NamedTuple):
    """Neighbouring cells of a row that belong to the same region."""

    start: Int[ndarray, "R"]  #: first cell of each run
    end: Int[ndarray, "R"]  #: the cell after its last
    region: Int[ndarray, "R"]  #: its region


def find_runs(labels: Int[ndarray, "P"]) -> Runs:
    """Return the runs of labelled cells; the padding has no label."""
    change = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    start = np.concatenate([[0], change])
    end = np.concatenate([change, [labels.size]])
    is_region = labels[start] >= 0
    return Runs(start[is_region], end[is_region], labels[start[is_region]])


def region_sums(before: Float[ndarray, "M P"], runs: Runs, number: int) -> Float[ndarray, "M number"]:
    """Sum M values over the cells of each region, from their cumulative sums."""
    return np.stack([np.bincount(runs.region, values, number) for values in _run_sums(before, runs)])


def region_moments(surface: Surface, runs: Runs, number: int) -> Float[ndarray, "12 number"]:
    """Sum 1, x, y, z, xx, xy, yy, xz, yz, zz and the gradients over the cells of each region."""
    z, yz, zz, gx, gy = _run_sums(surface.before, runs)
    n = (runs.end - runs.start).astype(np.float64)
    x, y = surface.x[runs.start], (surface.y[runs.start] + surface.y[runs.end - 1]) / 2
    yy = n * (y * y + (n * n - 1) / 12 * surface.resolution**2)  # of n cells in a row
    each = (n, n * x, n * y, z, n * x * x, n * x * y, yy, x * z, yz, zz, gx, gy)
    return np.stack([np.bincount(runs.region, values, number) for values in each])


def _run_sums(before: Float[ndarray, "M P"], runs: Runs) -> Float[ndarray, "M R"]:
    return np.take(before, runs.end, 1) - np.take(before, runs.start, 1)
