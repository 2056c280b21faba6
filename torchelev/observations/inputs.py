"""Check the inputs of observations: base poses, feet and noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.inputs.checks import FLOATS, check_pose, check_tensor
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float


class ScanInputs(NamedTuple):
    """What a height scan reads."""

    state: MapState  #: of the maps
    grid: GridConfig  #: the maps' grid
    T_map_base: Float[Tensor, "B 4 4"]  #: base poses
    feet: Float[Tensor, "B K 3"] | None  #: [m] positions of the feet, map frame; None of a scan around the base
    draws: Float[Tensor, "B P"] | None  #: in [0, 1), of the noise; None without noise


def check_base(emap: ElevationMap, T_map_base: object) -> Float[Tensor, "B 4 4"]:
    """Check the base poses and return them."""
    return check_pose("T_map_base", T_map_base, (emap.num_envs, 4, 4), emap.device, emap.check_values)


def check_feet(emap: ElevationMap, feet: object, num_feet: int) -> Float[Tensor, "B K 3"]:
    """Check the positions of the feet and return them."""
    shape, hint = (emap.num_envs, num_feet, 3), "give the feet's positions in the map frame"
    require(feet is not None, "feet", f"expected {shape}", "None", hint)
    value = check_tensor("feet", feet, emap.device, FLOATS)
    require(tuple(value.shape) == shape, "feet", f"expected {shape}", tuple(value.shape), hint)
    return value


def draw_noise(
    emap: ElevationMap, noise: bool | Float[Tensor, "B P"], num_points: int, amplitude: float
) -> Float[Tensor, "B P"] | None:
    """Return the draws of a scan's noise, in [0, 1); None without noise.

    Args:
        emap: the maps.
        noise: True draws the noise; a tensor in [0, 1) holds the draws.
        num_points: P.
        amplitude: of the noise [m], which must not be 0.
    """
    if noise is False:
        return None
    require(amplitude > 0, "noise", "must be off, as this scan has none", "on", "build it with noise=0.1")
    shape, dtype = (emap.num_envs, num_points), emap.elevation.dtype
    if noise is True:
        return torch.rand(shape, device=emap.device, dtype=dtype)
    value = check_tensor("noise", noise, emap.device, FLOATS)
    require(tuple(value.shape) == shape, "noise", f"expected {shape}", tuple(value.shape), "use torch.rand")
    return value.to(dtype)
