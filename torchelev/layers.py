"""The layers that can be read from a state, by name, and how they are sampled at points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

Layer = tuple[Tensor, Tensor]  # values, and the mask of where they are known, (B, H, W) both
MODES = ("bilinear", "nearest")  # how to sample a layer


def normal_component(gx: Tensor, gy: Tensor, axis: int) -> Tensor:
    """Return component x, y or z of a plane's unit normal, (-g_x, -g_y, 1) / sqrt(1 + g_x^2 + g_y^2)."""
    component = (-gx, -gy, torch.ones_like(gx))[axis]
    return component / (1 + gx.square() + gy.square()).sqrt()


def _normal(state: MapState, axis: int) -> Layer:
    return normal_component(state.gradient_x, state.gradient_y, axis), state.validity & state.has_normal


def _upper_bound(state: MapState) -> Layer:
    return torch.where(state.validity, state.elevation, state.upper_bound), state.validity | state.bounded


def _validity(state: MapState) -> Layer:
    return state.validity.to(state.elevation.dtype), torch.ones_like(state.validity)


def absolute_variance(state: MapState) -> Float[Tensor, "B H W"]:
    """Return the variance [m^2] of each elevation in the map frame: its own, and that of the pose."""
    return state.variance + pose_variance(state)


def pose_variance(state: MapState) -> Float[Tensor, "B H W"]:
    """Return n^T Sigma n [m^2] of the pose's position, at each cell.

    With n = (-dz/dx, -dz/dy, 1): on a slope, a map that is off sideways is off in height.
    """
    C = state.pose_covariance[..., None, None]
    gx, gy = state.gradient_x, state.gradient_y
    level = C[:, 0, 0] * gx.square() + 2 * C[:, 0, 1] * gx * gy + C[:, 1, 1] * gy.square()
    shared = level + C[:, 2, 2] - 2 * (C[:, 0, 2] * gx + C[:, 1, 2] * gy)
    return shared.clamp(min=0)


LAYERS: dict[str, Callable[[MapState], Layer]] = {
    "elevation": lambda state: (state.elevation, state.validity),
    "variance": lambda state: (absolute_variance(state), state.validity),
    "validity": _validity,
    "time": lambda state: (state.time, state.validity),
    "upper_bound": _upper_bound,
    "traversability": lambda state: (state.traversability, state.validity & state.rated),
    "normal_x": lambda state: _normal(state, 0),
    "normal_y": lambda state: _normal(state, 1),
    "normal_z": lambda state: _normal(state, 2),
}


class _Corners(NamedTuple):
    """The K cells that each of M points is read from."""

    cell: Int[Tensor, "B KM"]  # flat cell number; any cell where it does not count
    counts: Bool[Tensor, "B KM"]  # inside the window, and known
    weight: Float[Tensor, "B K M"]  # of the cell in the mean, 0 where it does not count


def sample_layer(
    layer: Layer, uv: Float[Tensor, "B M 2"], grid: GridConfig, mode: str
) -> tuple[Float[Tensor, "B M"], Bool[Tensor, "B M"]]:
    """Sample a layer at points.

    Args:
        layer: values and mask.
        uv: points, in cells from the window's corner.
        grid: the window.
        mode: "bilinear": the mean of the known ones of the four surrounding cells by their bilinear weights, valid if
            these sum to at least one half. "nearest": the cell that holds the point.

    Returns:
        Values, 0 where not valid, and the mask of where they are.
    """
    return sample_layers([layer], uv, grid, mode)[0]


def sample_layers(layers: Sequence[Layer], uv: Float[Tensor, "B M 2"], grid: GridConfig, mode: str) -> list[Layer]:
    """Sample several layers at the same points. Layers that share a mask share the look-up of their known cells."""
    around = _find_corners(uv, grid, mode)
    found: list[tuple[Tensor, _Corners]] = []
    sampled = []
    for values, known in layers:
        corners = next((corners for mask, corners in found if mask is known), None)
        if corners is None:
            corners = _drop_unknown(around, known)
            found.append((known, corners))
        sampled.append(_average(values, corners))
    return sampled


def surrounding_cells(uv: Float[Tensor, "B M 2"], mode: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return the whole numbers i, j of the K cells that points [cells] are read from, and their weights, (B, K, M)."""
    u, v = uv.unbind(-1)
    if mode == "nearest":
        i, j = (torch.floor(w)[:, None] for w in (u, v))
        return i, j, torch.ones_like(i)
    low_i, low_j = torch.floor(u - 0.5), torch.floor(v - 0.5)
    a, b = u - 0.5 - low_i, v - 0.5 - low_j
    i, j = torch.stack([low_i, low_i, low_i + 1, low_i + 1], 1), torch.stack([low_j, low_j + 1] * 2, 1)
    return i, j, torch.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], 1)


def containing_cells(uv: Float[Tensor, "B M 2"], grid: GridConfig) -> tuple[Int[Tensor, "B M"], Bool[Tensor, "B M"]]:
    """Return the flat number of the cell that holds each point [cells], and whether the point is in the window."""
    corners = _find_corners(uv, grid, "nearest")
    return corners.cell, corners.counts


def sample_lowest(layer: Layer, uv: Float[Tensor, "B M 2"], grid: GridConfig, mode: str) -> Layer:
    """Sample a layer by the lowest of its known cells around each point, of which a mean would say too much.

    Arguments and results are those of `sample_layer`; values may be infinite. "bilinear" looks at the four surrounding
    cells, of which the known ones must carry half of the weight.
    """
    corners = _drop_unknown(_find_corners(uv, grid, mode), layer[1])
    read = layer[0].flatten(1).gather(1, corners.cell)
    return lowest_counting(read.view_as(corners.weight), corners.counts.view_as(corners.weight), corners.weight)


def _find_corners(uv: Tensor, grid: GridConfig, mode: str) -> _Corners:
    finite = torch.isfinite(uv).all(-1, keepdim=True)
    far = min(1e6, torch.finfo(uv.dtype).max)
    i, j, weight = surrounding_cells(torch.where(finite, uv.clamp(-far, far), -far), mode)
    inside = (i >= 0) & (i < grid.height) & (j >= 0) & (j < grid.width)
    # In integers: float32 is exact up to 2^24 only.
    cell = (i.to(torch.int64) * grid.width + j.to(torch.int64)).clamp(0, grid.num_cells - 1)
    return _Corners(cell.flatten(1), inside.flatten(1), weight)


def _drop_unknown(corners: _Corners, known: Bool[Tensor, "B H W"]) -> _Corners:
    """Give unknown cells, and those outside the window, a weight of 0."""
    counts = corners.counts & known.flatten(1).gather(1, corners.cell)
    return _Corners(corners.cell, counts, corners.weight * counts.view_as(corners.weight))


def _average(values: Tensor, corners: _Corners) -> Layer:
    """Return the weighted mean over the known corners of each point, and where their weight suffices."""
    read = values.flatten(1).gather(1, corners.cell)
    corner = torch.where(corners.counts, read, 0.0).view_as(corners.weight)  # what is unknown must not reach gradients
    return weighted_mean(corner, corners.weight)


def lowest_counting(
    values: Float[Tensor, "B K M"], counts: Bool[Tensor, "B K M"], weight: Float[Tensor, "B K M"]
) -> Layer:
    """Return the lowest over K of the values that count, which may be infinite, and where `weighted_mean` is valid."""
    valid = weight.sum(1) >= 0.5
    return torch.where(valid, torch.where(counts, values, torch.inf).amin(1), 0.0), valid


def weighted_mean(values: Float[Tensor, "B K M"], weight: Float[Tensor, "B K M"]) -> Layer:
    """Return the weighted mean over K of finite values, and where their weight suffices: at least one half."""
    total = weight.sum(1)
    valid = total >= 0.5
    return (weight * values).sum(1) * valid / torch.where(valid, total, 1.0), valid
