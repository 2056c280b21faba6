"""Which points speak for the ground of which cell: the definition by tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.channels.fuse import Speakers
from torchelev.grid import GridConfig
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float

    from torchelev.inputs.update_inputs import Inputs


def find_speakers(inputs: Inputs, state: MapState, grid: GridConfig, noise: tuple[float, float]) -> Speakers:
    """Find the cell of each point, and how far its height is from the cell's elevation after the update.

    Args:
        inputs: of the update; M = S * N points.
        state: of the maps after it.
        grid: the window.
        noise: alpha_d and noise_floor [m^2] of sigma^2 = alpha_d d^2 + noise_floor (paper, Sec. II-A), for points
            without variances of their own.
    """
    points, T = inputs.points.float(), inputs.T_map_sensor
    finite = points.isfinite().all(-1) & T.isfinite().flatten(2).all(2)[..., None]
    p = torch.where(finite[..., None], points, 0.0)
    T = torch.where(T.isfinite(), T, 0.0)
    corner = torch.nn.functional.pad(state.corner.double() * grid.resolution, (0, 1))
    origin = (T[..., :3, 3].double() - corner[:, None]).float()  # from the window's corner, and from z = 0
    x, y, z = ((T[..., None, k, :3].float() * p).sum(-1) + origin[..., k, None] for k in range(3))
    i, j = (torch.floor(value * (1 / grid.resolution)) for value in (x, y))
    inside = finite & (i >= 0) & (i < grid.height) & (j >= 0) & (j < grid.width)
    i, j = (torch.where(inside, value, 0.0).to(torch.int64) for value in (i, j))
    slot = (i * grid.width + j).flatten(1)
    elevation, validity = (layer.flatten(1).gather(1, slot) for layer in (state.elevation, state.validity))
    if inputs.variance is None:
        variance = noise[0] * p.square().sum(-1) + noise[1]
    else:
        variance = torch.where(inputs.variance > 0, inputs.variance.float(), torch.inf)
    return Speakers(slot, inside.flatten(1) & validity, (z.flatten(1) - elevation).abs(), variance.flatten(1))


def floats_of(state: MapState) -> Float[Tensor, "B H W"]:
    """Return the elevation in float32, NaN where it is not known."""
    return torch.where(state.validity, state.elevation, torch.nan).float()
