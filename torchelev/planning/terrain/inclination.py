"""The inclination of a surface over the span of a robot's feet."""

from __future__ import annotations

import math

import torch

from torchelev.layers import Layer
from torchelev.ops.windows import AROUND, padded, shifted


def compute_inclination(surface: Layer, resolution: float, distance: float) -> Layer:
    """Compute how steeply a surface rises or falls around each cell.

    a = atan max_k |u_k - u| / d_k over the known ones of eight cells, the nearest to `distance` away along x, y and the
    diagonals. It is known where the cell and neighbours along two perpendicular directions are: one direction says
    nothing about the slope across it. Terrain between the nine cells does not count, as the robot steps over it.

    Args:
        surface: heights [m] and where they are known, (B, H, W).
        resolution: side of a cell [m].
        distance: half the span of the feet [m].

    Returns:
        The inclination [rad], 0 where not known, and where it is known, (B, H, W).
    """
    is_known = surface[1]
    height = torch.where(is_known, surface[0], 0.0)
    reach = max(1, round(distance / resolution))
    diagonal_reach = max(1, round(reach / math.sqrt(2)))
    offsets = [(i * n, j * n) for i, j in AROUND for n in [diagonal_reach if i and j else reach]]
    padded_height, padded_known = (padded(layer, reach, 0.0) for layer in (height, is_known.to(height.dtype)))
    max_slope = torch.zeros_like(height)
    has_neighbour = {axis: torch.zeros_like(is_known) for axis in ((1, 0), (0, 1), (1, 1), (1, -1))}
    for (i, j), axis in zip(offsets, map(_axis_of, AROUND), strict=True):
        step = shifted(padded_height, reach, i, j) - height
        neighbour_known = shifted(padded_known, reach, i, j)
        max_slope = torch.maximum(max_slope, step.abs() * neighbour_known / (math.hypot(i, j) * resolution))
        has_neighbour[axis] = has_neighbour[axis] | (neighbour_known > 0)
    spans_straight = has_neighbour[1, 0] & has_neighbour[0, 1]
    spans_diagonal = has_neighbour[1, 1] & has_neighbour[1, -1]
    found = is_known & (spans_straight | spans_diagonal)
    return torch.where(found, torch.atan(max_slope), 0.0), found


def _axis_of(step: tuple[int, int]) -> tuple[int, int]:
    """Return the axis of a step: the same for a step and its opposite."""
    i, j = step
    return (i, j) if (i, j) > (0, 0) else (-i, -j)
