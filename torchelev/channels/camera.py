"""Which pixel of a camera shows the ground of each cell: the definition by tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

NEAREST = 0.05  # [m] along the axis; what is nearer is not in the picture
_WIDEST = 8.0  # tangent of the largest angle from the axis, 83 degrees, that a lens model is asked for


class View(NamedTuple):
    """Cells as V cameras of each robot see them."""

    uv: Float[Tensor, "B V H W 2"]  #: [pixels] of the cell's centre; (0, 0) is the centre of the first pixel
    seen: Bool[Tensor, "B V H W"]  #: the cell is known, in the picture, and not hidden by the map


def project(
    state: MapState,
    grid: GridConfig,
    K: Float[Tensor, "B V 3 3"],
    T_map_camera: Float[Tensor, "B V 4 4"],
    size: tuple[int, int],
    distortion: Float[Tensor, "B V D"] | None,
) -> View:
    """Project the centres of cells into pictures of `size` (h, w) pixels, whether or not the map hides them.

    u = K (X / Z, Y / Z, 1) of (X, Y, Z) = R^T (p - t), in optical axes: x right, y down, z forward.
    """
    X, Y, Z = _in_camera(state, grid, T_map_camera)
    is_ahead = Z > NEAREST
    depth = torch.where(is_ahead, Z, 1.0)
    x, y = X / depth, Y / depth
    in_lens = is_ahead
    if distortion is not None:
        x, y, fits = distort(x, y, distortion[..., None, None, :])
        in_lens = is_ahead & fits
    k = K[..., None, None].float()
    u = k[:, :, 0, 0] * x + k[:, :, 0, 1] * y + k[:, :, 0, 2]
    v = k[:, :, 1, 1] * y + k[:, :, 1, 2]
    h, w = size
    inside = (u >= -0.5) & (u < w - 0.5) & (v >= -0.5) & (v < h - 0.5)
    return View(torch.stack([u, v], -1), state.validity[:, None] & in_lens & inside)


def _in_camera(state: MapState, grid: GridConfig, T_map_camera: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the ground at the centres of the cells in each camera's axes, (B, V, H, W) each."""
    x, y, z = from_camera(state, grid, T_map_camera)
    R = T_map_camera[..., :3, :3].float()[..., None, None]
    X, Y, Z = (R[:, :, 0, k] * x + R[:, :, 1, k] * y + R[:, :, 2, k] * z for k in range(3))
    return X, Y, Z


def from_camera(state: MapState, grid: GridConfig, T_map_camera: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x (B, V, H, 1), y (B, V, 1, W) and z (B, V, H, W) of the cells [m], map axes, seen from the cameras."""
    t = T_map_camera[..., :3, 3].double()
    first = (state.corner.double() + 0.5) * grid.resolution  # centre of the first cell
    offset = (first[:, None] - t[..., :2]).float()
    x = offset[..., 0, None] + grid.resolution * torch.arange(grid.height, device=t.device)
    y = offset[..., 1, None] + grid.resolution * torch.arange(grid.width, device=t.device)
    z = state.elevation.float()[:, None] - t[..., 2].float()[..., None, None]
    return x[..., None], y[..., None, :], z


def distort(x: Tensor, y: Tensor, D: Float[Tensor, "... D"]) -> tuple[Tensor, Tensor, Bool[Tensor, "..."]]:
    """Return where a lens shows points of the plane at depth 1, and which it can show.

    OpenCV's model: x_d = x f(r) + 2 p1 x y + p2 (r^2 + 2 x^2), y_d likewise, with r^2 = x^2 + y^2 and
    f = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6). Beyond the radius at which r f(r) begins to
    fall, its polynomial folds back into the picture: no lens shows what is there.

    Args:
        x: right of the axis.
        y: below it.
        D: k1, k2, p1, p2 and, if there are more, k3, and then k4, k5, k6.
    """
    r2 = x * x + y * y
    p1, p2 = D[..., 2], D[..., 3]
    f = _radial(r2, D)
    fits = r2.sqrt() < largest_radius(D)
    return x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * f + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y, fits


def _radial(r2: Tensor, D: Tensor) -> Tensor:
    k = [D[..., n] if n < D.shape[-1] else torch.zeros_like(D[..., 0]) for n in (0, 1, 4, 5, 6, 7)]
    return (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))


def largest_radius(D: Float[Tensor, "... D"]) -> Float[Tensor, "..."]:
    """Return the radius up to which r f(r) grows."""
    r = torch.linspace(0.0, _WIDEST, 512, device=D.device)
    shown = r * _radial((r * r).expand(*D.shape[:-1], len(r)), D[..., None, :])
    falls = shown.diff(dim=-1) <= 0
    first = torch.where(falls.any(-1), falls.int().argmax(-1), len(r) - 1)
    return r[first]


def hidden(
    state: MapState, grid: GridConfig, T_map_camera: Float[Tensor, "B V 4 4"], margin: float
) -> Bool[Tensor, "B V H W"]:
    """Return which cells the map hides from each camera.

    The line from the camera to the cell's centre passes more than `margin` [m] below the elevation of a known cell
    between them. It is looked at as often as it is cells long along x or y, and so is each cell that it passes.
    """
    x, y, z = from_camera(state, grid, T_map_camera)
    at = torch.stack([-x[..., 0, 0], -y[..., 0, 0]], -1) / grid.resolution + 0.5  # the camera, in cells
    x, y = x / grid.resolution, y / grid.resolution
    steps = torch.maximum(x.abs(), y.abs()).ceil().clamp(min=1)
    high = torch.where(state.validity, state.elevation.float(), -torch.inf).flatten(1)
    height = T_map_camera[..., 2, 3].float()[..., None, None]
    result = torch.zeros(torch.broadcast_shapes(x.shape, y.shape), dtype=torch.bool, device=x.device)
    for back in range(1, max(grid.height, grid.width)):  # what lies farther back is out of the window
        share = (steps - back).clamp(min=0) / steps
        i = torch.floor(at[..., 0, None, None] + share * x)
        j = torch.floor(at[..., 1, None, None] + share * y)
        inside = (i >= 0) & (i < grid.height) & (j >= 0) & (j < grid.width) & (back < steps)
        slot = torch.where(inside, i, 0).to(torch.int64) * grid.width + torch.where(inside, j, 0).to(torch.int64)
        ground = high[:, None].expand(*slot.shape[:2], -1).gather(2, slot.flatten(2)).view(slot.shape)
        result |= inside & (ground > height + share * z + margin)
    return result
