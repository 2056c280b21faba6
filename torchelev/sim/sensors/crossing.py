"""Where a ray meets the surface within one cell of a height field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.sim.terrains.surfaces import Coefficients, Surface

if TYPE_CHECKING:
    from jaxtyping import Float

HUGE = 1e30  # [m] longer than any range


def intersect(
    surface: Surface,
    coefficients: Coefficients,
    inside: Float[Tensor, "2 E N"],
    z: Float[Tensor, "E N"],
    step: Float[Tensor, "3 N"],
    leave: Float[Tensor, "E N"],
) -> Float[Tensor, "E N"]:
    """Return how far [m] behind its entry into each of E cells a ray hits the surface, HUGE if not within the cell.

    A ray that enters below the ground hits at its entry. Inputs are overwritten.

    Args:
        surface: How the surface continues between the samples.
        coefficients: Its a, b, c, d in each cell, (E, N) each.
        inside: Position of the entry in the cell, from 0 to 1.
        z: Height of the entry [m].
        step: Change of x, y [cells] and z [m] per metre along the ray.
        leave: How far [m] behind the entry the ray leaves the cell.
    """
    if surface is Surface.BILINEAR:
        return _hit_bilinear(coefficients, inside, z, step, leave)
    return _hit_triangles(surface, coefficients, inside, z, step, leave)


def _hit_bilinear(coefficients: Coefficients, inside: Tensor, z: Tensor, step: Tensor, leave: Tensor) -> Tensor:
    """Solve for s in over - sinking s - bend s^2 = 0, the height above the ground s metres behind the entry."""
    (a, b, c, d), (u, v), (step_x, step_y, step_z) = coefficients, inside, step
    slope_x = torch.addcmul(b, d, v)
    over = z.sub_(a).addcmul_(slope_x, u, value=-1).addcmul_(c, v, value=-1)
    sinking = slope_x.mul_(step_x).addcmul_(c.addcmul_(d, u), step_y).sub_(step_z)
    # The first root, in the form that also holds for bend = 0; NaN where there is none.
    root = d.mul_(4 * step_x * step_y).mul_(over).addcmul_(sinking, sinking)
    root = over.mul(2).div_(sinking.addcmul_(root.rsqrt(), root))
    # Negative where the root is not in [0, leave]. On a CPU, conditions take many times as long as this arithmetic.
    outside = (leave - root).mul_(root).clamp_(max=0)
    root = root.sub_(outside.mul_(HUGE)).nan_to_num_(HUGE, HUGE, HUGE)
    return torch.minimum(root, over.clamp_(min=0).mul_(HUGE))


def _hit_triangles(
    surface: Surface, coefficients: Coefficients, inside: Tensor, z: Tensor, step: Tensor, leave: Tensor
) -> Tensor:
    """Intersect the ray with the planes of both triangles: the ground is the upper or the lower one of them.

    Where it is the lower one, a ray is below the ground once it is below both. None slips through the diagonal.
    """
    (a, b, c, d), (u, v), (step_x, step_y, step_z) = coefficients, inside, step
    is_falling = surface is Surface.FALLING
    # The planes meet the diagonal's corners and one further corner each.
    over = z - a - b * u - c * v
    first = over if is_falling else over - d * v
    second = over - d * (u + v - 1) if is_falling else over - d * u
    sinking = b * step_x + c * step_y - step_z
    first_sinking = sinking if is_falling else sinking + d * step_y
    second_sinking = sinking + d * (step_x + step_y) if is_falling else sinking + d * step_x
    (begin, end), (other_begin, other_end) = _below(first, first_sinking), _below(second, second_sinking)
    is_lower = d < 0 if is_falling else d > 0
    both = torch.maximum(begin, other_begin)
    both = torch.where(both <= torch.minimum(end, other_end), both, HUGE)
    hit = torch.where(is_lower, both, torch.minimum(begin, other_begin))
    return torch.where(hit <= leave, hit, HUGE)


def _below(over: Tensor, sinking: Tensor) -> tuple[Tensor, Tensor]:
    """Return from where to where [m] ahead a ray is below a plane, which it is `over` [m] above at first."""
    crossing = over / sinking
    begin = torch.where(over <= 0, 0.0, torch.where(sinking > 0, crossing, HUGE))
    return begin, torch.where(sinking < 0, crossing, math.inf)
