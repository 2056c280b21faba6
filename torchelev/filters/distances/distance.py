"""Distances to edges, obstacles and unknown ground."""

from __future__ import annotations

import functools
import math
import operator
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from torchelev.errors import require_positive
from torchelev.filters import opencv
from torchelev.filters.distances import opencv_distance
from torchelev.filters.distances.opencv_distance import FAR
from torchelev.filters.registry import register
from torchelev.layers import Layer
from torchelev.ops.masks import where_finite
from torchelev.ops.transforms import can_compute_unseen

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

Values = TypeVar("Values", Tensor, NDArray)


@register
def signed_distance(
    layer: Layer,
    *,
    resolution: float,
    step: float | None = 0.1,
    below: float | None = None,
    above: float | None = None,
    unknown: bool = True,
    max_distance: float | None = None,
) -> Layer:
    """Return the distance [m] from each cell's centre to the nearest border, negative inside obstacles.

    Obstacles are cells with a value under `below` or over `above`. Borders lie between cells that share a side: around
    obstacles; between other cells whose values differ by more than `step`, an edge, which has no inside; and around
    known ground. On elevation `step` finds edges; on traversability `step=None, below=0.5` finds where not to drive.

    d = (|c - n| + 1/2) resolution, with |c - n| in cells from the cell c to the nearest cell n beside a border: exact
    at straight borders along the grid, up to half a cell off elsewhere. Never above the map's diagonal. Ground steeper
    than step / resolution is all edges. No gradient. Uses OpenCV on a CPU if installed; tensor operations take a time
    per cell that grows with the map's larger side or `max_distance`, in cells.

    Args:
        layer: values and mask (B, H, W).
        resolution: [m] of a cell.
        step: unit of the values; None finds no edges.
        below: unit of the values; None for no such obstacles.
        above: unit of the values; None for no such obstacles.
        unknown: whether borders to unknown cells and the map's rim count.
        max_distance: [m] upper limit of the result.

    Raises:
        ValueError: if `step` or `max_distance` is not positive.
    """
    values, known = layer
    for name, setting in dict(step=step, max_distance=max_distance).items():
        if setting is not None:
            require_positive(**{name: setting})
    reach = math.hypot(*values.shape[1:])
    if max_distance is not None:
        reach = min(reach, max_distance / resolution)
    limit = FAR / 10 if step is None else step  # above all steps of the ground, below those to FAR
    if opencv.is_usable(values.detach()):
        heights, mask = values.detach().numpy(), known.numpy()
        cells = opencv_distance.signed_cells(heights, mask, _obstacles(heights, below, above), limit, unknown, reach)
        cells *= np.float32(resolution)
        return torch.from_numpy(cells), known
    obstacle = _obstacles(values, below, above)
    borders = _beside_borders(values.detach(), known, obstacle, limit, unknown)
    squared = squared_distance(borders, math.ceil(reach)).to(values.dtype)
    distance = (squared.sqrt() + 0.5).clamp(max=reach) * resolution
    return distance if obstacle is None else where_finite(obstacle, -distance, distance), known


def _obstacles(values: Values, below: float | None, above: float | None) -> Values | None:
    """Return which cells are obstacles, None if both limits are None."""
    rules = [values < below] if below is not None else []
    rules += [values > above] if above is not None else []
    return functools.reduce(operator.or_, rules) if rules else None


def _beside_borders(level: Tensor, known: Tensor, obstacle: Tensor | None, limit: float, unknown: bool) -> Tensor:
    """Return which cells have a border on one of their four sides.

    Obstacles are moved far above and unknown cells far below all ground: level planes, so that borders lie only around
    them. Unknown cells may be marked too; a known neighbour, marked with them, is always nearer.
    """
    if obstacle is not None:
        level = where_finite(~obstacle, level, FAR)
    level = where_finite(known, level, -FAR)
    rimmed, rimmed_known = F.pad(level, [1] * 4, value=-FAR), F.pad(known, [1] * 4)
    beside = torch.zeros_like(known)
    for dim in (1, 2):
        size = known.shape[dim]
        lines = rimmed.narrow(3 - dim, 1, known.shape[3 - dim])
        border = (lines.narrow(dim, 1, size + 1) - lines.narrow(dim, 0, size + 1)).abs() > limit
        if not unknown:
            lines = rimmed_known.narrow(3 - dim, 1, known.shape[3 - dim])
            border = border & lines.narrow(dim, 1, size + 1) & lines.narrow(dim, 0, size + 1)
        beside = beside | border.narrow(dim, 0, size) | border.narrow(dim, 1, size)
    return beside


def squared_distance(seeds: Bool[Tensor, "B H W"], reach: int) -> Float[Tensor, "B H W"]:
    """Return the squared distance [cells^2] between each cell's centre and the nearest seed's, exact up to `reach`.

    Whole numbers. More than reach^2 beyond `reach` [cells], and on maps without seeds.
    """
    if can_compute_unseen([seeds]) and opencv.is_installed():
        cells = opencv_distance.nearest_seed(seeds.numpy(), reach + 1)
        return torch.from_numpy(np.rint(cells * cells))
    return squared_distance_by_tensors(seeds, reach)


def squared_distance_by_tensors(seeds: Bool[Tensor, "B H W"], reach: int) -> Float[Tensor, "B H W"]:
    """Compute `squared_distance` without OpenCV.

    Distances along W by doubling steps, then along H the minimum of squared distances over all shifts.
    """
    H, W = seeds.shape[1:]
    line = torch.where(seeds, 0.0, float(reach + 1))
    step = 1
    while step < min(W, reach + 1):
        line[..., step:] = torch.minimum(line[..., step:], line[..., :-step] + step)
        line[..., :-step] = torch.minimum(line[..., :-step], line[..., step:] + step)
        step *= 2
    line = line.square_()
    squared = line.clone()
    for shift in range(1, min(H, reach + 1)):
        shifted = line + shift * shift
        squared[:, shift:] = torch.minimum(squared[:, shift:], shifted[:, :-shift])
        squared[:, :-shift] = torch.minimum(squared[:, :-shift], shifted[:, shift:])
    return squared
