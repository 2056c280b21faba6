"""Check the inputs of observations: base poses, feet and noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.inputs.checks import FLOATS, check_pose, check_tensor

if TYPE_CHECKING:
    from jaxtyping import Float


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
    """Return uniform noise in [-amplitude, amplitude); None without noise.

    Args:
        emap: the maps.
        noise: True draws the noise; a tensor in [0, 1) holds the draws.
        num_points: P.
        amplitude: half the width of the distribution.
    """
    if noise is False:
        return None
    require(amplitude > 0, "noise", "must be off, as this scan has none", "on", "build it with noise=0.1")
    shape, dtype = (emap.num_envs, num_points), emap.elevation.dtype
    if noise is True:
        draws = torch.rand(shape, device=emap.device, dtype=dtype)
    else:
        value = check_tensor("noise", noise, emap.device, FLOATS)
        require(tuple(value.shape) == shape, "noise", f"expected {shape}", tuple(value.shape), "use torch.rand")
        draws = value.to(dtype)
    return (2 * draws - 1) * amplitude
