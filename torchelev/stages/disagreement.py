"""Sensors or poses that contradict each other in height: no cell is more certain than they agree."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.inputs.checks import readable
from torchelev.ops.operators import cell_sums
from torchelev.ops.storage import stored
from torchelev.stages.cells import cells_of
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Float

_SIGNIFICANT = 3.0  # standard errors
_NEWEST = 0.2  # share of the newest scan in the running mean
_MAX_BIAS = 0.1  # [m] from the mean of a cell; farther sensors see another side of an edge
_MIN_CELLS = 20  # cells in which a sensor must be compared with others
_LEAST = 1e-12  # [m^2] of a variance


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
    product = last * correction * (correction.square() > _SIGNIFICANT**2 * error_variance)
    mean = (d2 - _NEWEST * (product + d2)).clamp(min=0)
    return torch.where((last != 0) & (correction != 0), mean, d2).sqrt().detach()


@stored
def compare_sensors(state: MapState, m: Measurement, grid: GridConfig) -> Float[Tensor, "B"]:
    """Return the standard deviation [m] of the height error of each of S sensors, as the cells they share show it.

    d^2 = 1 / (S - 1) * sum (e_s - e)^2 with the mean difference e_s of a sensor's heights from those of all, over the
    cells that at least two see, without the slope of the ground within a cell; 0 within the noise of these means.
    """
    cells, sensors = cells_of(state, m, grid), m.origin.shape[1]
    x, y, z = m.points.detach().unbind(-1)
    gx, gy = cells.take(state.gradient_x.detach(), state.gradient_y.detach())
    inside = cells.inside.to(z.dtype)
    level = (z * inside).sum(1, keepdim=True) / inside.sum(1, keepdim=True).clamp(min=1)
    size = grid.resolution
    z = z - level - gx * (x - (torch.floor(x / size) + 0.5) * size) - gy * (y - (torch.floor(y / size) + 0.5) * size)
    columns = torch.stack([inside, inside * z]).view(2, -1, m.points.shape[1] // sensors)
    number, moment = cell_sums(cells.slot.view(columns.shape[1:]), columns, grid.num_cells).unbind(0)
    number, moment = (values.view(-1, sensors, grid.num_cells) for values in (number, moment))
    seen, height = number > 0, moment / number.clamp(min=1)
    error = height - height.sum(1, keepdim=True) / seen.sum(1, keepdim=True).clamp(min=1)
    shared = seen & (seen.sum(1, keepdim=True) > 1) & (error.abs() <= _MAX_BIAS)
    count = shared.sum(2)
    bias = (error * shared).sum(2) / count.clamp(min=1)
    counts = count >= _MIN_CELLS
    mean = (bias * counts).sum(1, keepdim=True) / counts.sum(1, keepdim=True).clamp(min=1)
    compared = counts.sum(1)
    d2 = ((bias - mean).square() * counts).sum(1) / (compared - 1).clamp(min=1)
    noise = ((error - bias[..., None]).square() * shared).sum(2) / count.clamp(min=1).square()  # of each mean
    noise = (noise * counts).sum(1) / compared.clamp(min=1)
    d = torch.where(d2 > _SIGNIFICANT**2 * noise, d2, 0.0).sqrt()
    return torch.where(compared > 1, d, state.statistics.disagreement)


def without_disagreement(state: MapState) -> Tensor:
    """Return the variance (B, H, W) of each cell relative to the others, which updates compute with."""
    return _add(state, -1.0).clamp(min=_LEAST)


def with_disagreement(state: MapState) -> Tensor:
    """Return the variance (B, H, W) of each cell, with what scans or sensors disagree by."""
    return _add(state, 1.0)


def _add(state: MapState, sign: float) -> Tensor:
    return state.variance + sign * state.statistics.disagreement.square()[:, None, None] * state.validity


@contextmanager
def relative_variance(stored: MapState) -> Iterator[None]:
    """Take the disagreement out of the stored variances while the block updates them, and add what it is then."""
    if _may_disagree(stored):
        stored.variance.copy_(without_disagreement(stored))
    try:
        yield
    finally:
        if _may_disagree(stored):
            stored.variance.copy_(with_disagreement(stored))


def _may_disagree(state: MapState) -> bool:
    """Return whether anything disagrees, or the host cannot know without waiting."""
    disagreement = state.statistics.disagreement
    return not readable(disagreement) or bool(disagreement.any())
