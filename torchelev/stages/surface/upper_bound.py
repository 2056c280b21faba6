"""Normals of the upper bound, by the differences to the next cells."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.ops.windows import padded, shifted
from torchelev.plane_fit import Normals
from torchelev.stages.surface.config import SurfaceConfig
from torchelev.state import MapState
from torchelev.traversability.paper_filter import RIM, PaperFilter

if TYPE_CHECKING:
    from jaxtyping import Float


@functools.lru_cache(maxsize=8)
def filter_of(path: str, device: torch.device) -> PaperFilter:
    """Return the filter whose weights a file holds, read once."""
    return PaperFilter.from_npz(path).requires_grad_(False).to(device)


def require_filter(cfg: SurfaceConfig) -> None:
    """Refuse a file of weights that cannot be read."""
    if cfg.upper_bound is not None and cfg.upper_bound.filter_weights is not None:
        filter_of(str(cfg.upper_bound.filter_weights), torch.device("cpu"))


def rate_upper_bound(state: MapState, dilation: int, path: str) -> MapState:
    """Rate the dilated upper bound by the filter; cells that are known or bounded, but for a border of RIM - 1."""
    rated = filter_of(path, state.elevation.device)(dilated(state, dilation, border=1))[:, 1:-1, 1:-1]
    inner = F.pad(torch.ones_like(rated[:, 2 * RIM - 2 :, 2 * RIM - 2 :], dtype=torch.bool), [RIM - 1] * 4)
    known = (state.validity | state.bounded) & inner
    return state._replace(traversability=torch.where(known, rated, 0.0), rated=known)


def normals_of_upper_bound(state: MapState, dilation: int, resolution: float) -> Normals:
    """Return the gradients of the dilated upper bound, (h[i + 1] - h) / resolution, of known cells."""
    height = dilated(state, dilation)
    has_normal = state.validity.clone()
    has_normal[:, -1], has_normal[:, :, -1] = False, False
    gradients = (F.pad(height.diff(dim=dim), (0, 0, 0, 1) if dim == 1 else (0, 1)) / resolution for dim in (1, 2))
    gx, gy = (torch.where(has_normal, gradient, 0.0) for gradient in gradients)
    return Normals(gx, gy, has_normal)


def dilated(state: MapState, radius: int, border: int = 0) -> Float[Tensor, "B H W"]:
    """Return the elevation, or the upper bound, or that of a cell near it; 0 where there is none.

    Of the cells within `radius` along x and y, that with the smallest sum of the distances along x and y counts, with
    their signs: the one nearest to the corner of the window. `border` cells around the map are added as unknown ones.
    """
    known = padded(state.validity | state.bounded, border, False)
    height = padded(torch.where(state.validity, state.elevation, state.upper_bound), border, 0.0)
    height = torch.where(known, height, 0.0)
    around, exists = padded(height, radius, 0.0), padded(known.to(height.dtype), radius, 0.0)
    steps = range(-radius, radius + 1)
    filled = height
    for i, j in sorted(((i, j) for i in steps for j in steps), key=sum, reverse=True):
        filled = torch.where(shifted(exists, radius, i, j) > 0, shifted(around, radius, i, j), filled)
    return torch.where(known, height, filled)
