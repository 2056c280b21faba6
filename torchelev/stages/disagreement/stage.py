"""By how much sensors, or successive scans, disagree in height; the variance of every cell covers it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.indexing import read
from torchelev.ops.scatter import cell_sums
from torchelev.stages.cells import PointCells, cells_of
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Float

SIGNIFICANT = 3.0  # standard errors
NEWEST = 0.2  # share of the newest scan in the running mean
MAX_BIAS = 0.1  # [m] from the mean of a cell; farther sensors see another side of an edge
MIN_CELLS = 20  # cells in which a sensor must be compared with others
LEAST = 1e-12  # [m^2] of a variance


def compare_scans(
    before: MapState, correction: Float[Tensor, "B"], error_variance: Float[Tensor, "B"]
) -> Float[Tensor, "B"]:
    """Return the standard deviation [m] of the height error of each scan, as drift corrections show it.

    Errors n_k of each scan's own give corrections c_k = n_k - n_k-1, of which one and the next have the covariance
    -d^2; those of steady drift have none.

        d^2 <- max(0, d^2 + w (-c_k-1 c_k - d^2))

    Args:
        before: the state with the statistics of the last update.
        correction: [m] c_k; 0 where no correction was made, which leaves d as it was.
        error_variance: [m^2] of the correction, as the noise of its points makes it; no c_k within it counts.
    """
    last, d2 = before.statistics.drift_correction, before.statistics.disagreement.square()
    product = last * correction * (correction.square() > SIGNIFICANT**2 * error_variance)
    mean = (d2 - NEWEST * (product + d2)).clamp(min=0)
    return torch.where((last != 0) & (correction != 0), mean, d2).sqrt().detach()


def compare_sensors(state: MapState, m: Measurement, grid: GridConfig) -> Float[Tensor, "B"]:
    """Return the standard deviation [m] of the height error of each of S sensors, as the cells they share show it.

    d^2 = 1 / (S - 1) * sum (e_s - e)^2 with the mean difference e_s of a sensor's heights from those of all, over the
    cells that at least two see, without the slope of the ground within a cell; 0 within the noise of these means.
    """
    cells, sensors = cells_of(state, m, grid), m.origin.shape[1]
    z, inside = _level_heights(state, m, grid, cells)
    # Sums over cells are taken over points, of weight 1 / n in a cell with n of the sensor: these are fewer.
    slot = cells.slot.view(len(m.origin) * sensors, -1)
    columns = torch.stack([inside, inside * z])
    sums = cell_sums(slot, columns.view(2, *slot.shape), grid.num_cells).unbind(0)
    number, moment = (read(values, slot).view_as(z) for values in sums)
    number = number.clamp(min=1)
    weight, height = inside / number, moment / number
    sensors_in_cell, mean = cells.take(*cells.sums(weight, weight * height))
    error = height - mean / sensors_in_cell.clamp(min=1)
    # Sums of weights are whole numbers up to rounding.
    weight = weight * ((sensors_in_cell > 1.5) & (error.abs() <= MAX_BIAS))
    error, weight = (values.unflatten(1, (sensors, -1)) for values in (error, weight))
    count = weight.sum(2)
    bias = (weight * error).sum(2) / count.clamp(min=1)
    counts = count > MIN_CELLS - 0.5
    compared = counts.sum(1)
    mean = (bias * counts).sum(1, keepdim=True) / compared[:, None].clamp(min=1)
    d2 = ((bias - mean).square() * counts).sum(1) / (compared - 1).clamp(min=1)
    noise = (weight * (error - bias[..., None]).square()).sum(2) / count.clamp(min=1).square()  # of each mean
    noise = (noise * counts).sum(1) / compared.clamp(min=1)
    d = torch.where(d2 > SIGNIFICANT**2 * noise, d2, 0.0).sqrt()
    return torch.where(compared > 1, d, state.statistics.disagreement)


def _level_heights(state: MapState, m: Measurement, grid: GridConfig, cells: PointCells) -> tuple[Tensor, Tensor]:
    """Return the height [m] of each point without the slope of its cell, and 1 where it measures the ground, else 0.

    Heights count from the mean, so that their sums keep the precision.
    """
    x, y, z = m.points.detach().unbind(-1)
    inside, size = cells.inside.to(z.dtype), grid.resolution
    level = (z * inside).sum(1, keepdim=True) / inside.sum(1, keepdim=True).clamp(min=1)
    gx, gy = cells.take(state.gradient_x.detach(), state.gradient_y.detach())
    x, y = (values - (torch.floor(values / size) + 0.5) * size for values in (x, y))
    return z - level - gx * x - gy * y, inside


def without_disagreement(state: MapState) -> Tensor:
    """Return the variance (B, H, W) of each cell relative to the others, which updates compute with."""
    return torch.maximum(_add(state, -1.0), state.variance.clamp(max=LEAST))


def with_disagreement(state: MapState) -> Tensor:
    """Return the variance (B, H, W) of each cell, with what scans or sensors disagree by."""
    return _add(state, 1.0)


def _add(state: MapState, sign: float) -> Tensor:
    return state.variance + sign * state.statistics.disagreement.square()[:, None, None] * state.validity


def subtract_disagreement(state: MapState) -> MapState:
    """Make variances relative to the other cells of the map, for the stages that follow."""
    return state._replace(variance=without_disagreement(state))


def add_disagreement(state: MapState) -> MapState:
    """Make every variance cover by how much scans or sensors disagree, as this update knows it."""
    return state._replace(variance=with_disagreement(state))
