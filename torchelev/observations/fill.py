"""Reading layers at points, and the ground that is assumed where the map knows nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.layers import LAYERS, Layer, sample_layers
from torchelev.observations.ground import continue_ground
from torchelev.ops.operators import padded
from torchelev.ops.windows import window_moments
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

MODES = ("bilinear", "nearest", "minimum")
FILLS = ("ground", "base", "lowest", "upper_bound", "inpaint")
ORIGINAL = "original"


def require_mode(mode: object) -> None:
    """Refuse a mode of reading that does not exist."""
    require(mode in MODES, "mode", f"must be one of {', '.join(MODES)}", repr(mode), "use bilinear")


def require_fill(name: str, fill: object, names: Sequence[str], clip: float | None) -> None:
    """Refuse what is neither a rule's name nor a number; inf may only stand where it is clipped."""
    number = isinstance(fill, int | float) and not isinstance(fill, bool)
    named = isinstance(fill, str) and fill in names
    require(number or named, name, f"must be a number or one of {', '.join(names)}", repr(fill), "use ground")
    if isinstance(fill, int | float):
        bounded = math.isfinite(fill) or (clip is not None and not math.isnan(fill))
        require(bounded, name, "must be finite where nothing clips", fill, "give metres, or clip")


def read_points(layers: Sequence[Layer], uv: Float[Tensor, "B M 2"], grid: GridConfig, mode: str) -> list[Layer]:
    """Read layers (B, H, W) at `uv`, in cells from the window's corner: values (B, M), 0 where not known, and known.

    "bilinear" and "nearest" as in `ElevationMap.sample`. "minimum" is the lowest known of three cells: the one whose
    centre comes before the point in x and y, the next one in x, the next one in y. legged_gym reads the corners of its
    height field so.
    """
    if mode != "minimum":
        return sample_layers(layers, uv, grid, mode)
    before = uv - 0.5
    one, none = torch.ones_like(uv[..., :1]), torch.zeros_like(uv[..., :1])
    around = [before, before + torch.cat([one, none], -1), before + torch.cat([none, one], -1)]
    corners = sample_layers(layers, torch.cat(around, 1), grid, "nearest")
    return [lowest(values.unflatten(1, (3, -1)), known.unflatten(1, (3, -1)), dim=1) for values, known in corners]


def fill_unknown(
    fill: str | float,
    state: MapState,
    uv: Float[Tensor, "B M 2"],
    base: tuple[Float[Tensor, "B 1 2"], Float[Tensor, "B 1"]],
    read: Layer,
    grid: GridConfig,
    mode: str,
    half: tuple[int, int],
    rings: int,
) -> Layer:
    """Complete heights that were read (B, M) by a rule: heights, and where the map or the rule knows one.

    "base" and numbers know no ground. `base`: where it is, in cells from the window's corner, and its height [m].
    `half`: how many cells along x and y from the window's centre the points may lie. `rings`: how far to inpaint.
    """
    heights, known = read
    if fill == "ground":
        ground, found = continue_ground((state.elevation, state.validity), uv, *base, grid, half)
    elif fill == "lowest":
        ground, found = (part[:, None] for part in lowest(heights, known, dim=1))
    elif fill == "upper_bound":
        ((ground, found),) = read_points([LAYERS["upper_bound"](state)], uv, grid, mode)
    elif fill == "inpaint":
        ((ground, found),) = read_points([inpaint((state.elevation, state.validity), half, rings)], uv, grid, mode)
    else:
        return heights, known
    return torch.where(known, heights, ground), known | found


def lowest(heights: Float[Tensor, "B *M"], known: Bool[Tensor, "B *M"], dim: int) -> Layer:
    """Return the lowest known height along a dimension, and whether there is one."""
    low = torch.where(known, heights, torch.inf).amin(dim)
    found = torch.isfinite(low)
    return torch.where(found, low, 0.0), found


def inpaint(layer: Layer, half: tuple[int, int], rings: int) -> Layer:
    """Fill unknown cells with the mean of their known neighbours, of eight: `rings` times, each a ring of cells.

    Only cells that points or their filling need are looked at: `half` + `rings` cells along x and y to each side of
    the window's centre. Of the others nothing is known.
    """
    values, known = layer
    H, W = values.shape[1:]
    top, left = (max(0, n // 2 - cells - rings) for n, cells in zip((H, W), half, strict=True))
    part = known[:, top : H - top, left : W - left]
    heights = torch.where(part, values[:, top : H - top, left : W - left], 0.0)
    both = torch.stack([heights, part.to(values.dtype)], 1)  # height and weight, 0 or 1
    for _ in range(rings):
        (sums,) = window_moments([(padded(both, 1, 0.0), 0)], 1, 1)  # on a CPU, a twelfth of pooling's time
        both = torch.where(both[:, 1:] > 0, both, sums / sums[:, 1:].clamp(min=1))
    heights, weight = both.unbind(1)
    rim = [left, left, top, top]
    return F.pad(heights, rim), F.pad(weight, rim) > 0
