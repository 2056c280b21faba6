"""Find the points on the robot by intersecting pieces of their rays with its shapes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.robot_body.posing import PosedBody, dot
from torchelev.robot_body.shapes import RobotBody

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_TINY = 1e-12


class _Pieces(NamedTuple):
    """Pieces of rays, from `near` to `far` along their directions, in the sensor frame."""

    direction: list[Tensor]  #: x, y, z (B, S, N) of unit vectors
    near: Float[Tensor, "B S N"]  #: [m]
    far: Float[Tensor, "B S N"]  #: [m]


def find_own_points(
    x: Float[Tensor, "B S N"], y: Tensor, z: Tensor, squared: Float[Tensor, "B S N"], posed: PosedBody, body: RobotBody
) -> Bool[Tensor, "B S N"]:
    """Return which points of the sensor frame lie on the robot, see `RobotBody`; `squared` is their squared distance.

    The smallest excess decides, which is at most 0 where a shape is met: compiled code is slow at joining masks.
    """
    pieces = _pieces_behind(x.detach(), y.detach(), z.detach(), squared.detach(), body.depth_tolerance)
    min_excess = torch.full_like(pieces.near, torch.inf)
    for k in range(len(body.capsules)):
        min_excess = torch.minimum(min_excess, _excess_of_capsule(pieces, posed, body, k))
    for k in range(len(body.boxes)):
        min_excess = torch.minimum(min_excess, _excess_of_box(pieces, posed, body, k))
    return min_excess <= 0


def _pieces_behind(x: Tensor, y: Tensor, z: Tensor, squared: Tensor, length: float) -> _Pieces:
    """Return the pieces of these points' rays that begin at the points, which lie at these squared distances."""
    distance = squared.clamp(min=_TINY).sqrt()
    inverse = 1 / distance
    return _Pieces([x * inverse, y * inverse, z * inverse], distance, distance + length)


def _excess_of_capsule(pieces: _Pieces, posed: PosedBody, body: RobotBody, k: int) -> Float[Tensor, "B S N"]:
    """Return the squared distance of the pieces from a capsule's axis, less its squared radius with padding [m^2].

    With the ray's unit vector d and the axis from a to a + e, |t d - a - v e|^2 is least where both t and v are least
    for the other, each kept in its interval (Ericson, "Real-Time Collision Detection", 5.1.9).
    """
    capsule = body.capsules[k]
    start, axis = (value[..., k, None] for value in (posed.start, posed.axis))
    start_start, start_axis = posed.start_start[..., k, None], posed.start_axis[..., k, None]
    squared, limit = capsule.length**2, (capsule.radius + body.padding) ** 2
    on_start, on_axis = dot(pieces.direction, start), dot(pieces.direction, axis)
    if not capsule.length:
        t = torch.minimum(torch.maximum(on_start, pieces.near), pieces.far)
        return t * (t - 2 * on_start) + start_start - limit
    v = ((on_start * on_axis - start_axis) / (squared - on_axis * on_axis).clamp(min=_TINY)).clamp(0, 1)
    t = torch.minimum(torch.maximum(on_start + v * on_axis, pieces.near), pieces.far)
    v = ((t * on_axis - start_axis) / squared).clamp(0, 1)
    distance2 = t * (t - 2 * (on_start + v * on_axis)) + start_start + v * (2 * start_axis + v * squared)
    return distance2 - limit


def _excess_of_box(pieces: _Pieces, posed: PosedBody, body: RobotBody, k: int) -> Float[Tensor, "B S N"]:
    """Return how far apart [m along the ray] pieces and the padded box are; at most 0 where they meet."""
    half = [h + body.padding for h in body.boxes[k].half_lengths]
    to_box, origin = posed.to_box[..., k, None], posed.origin[..., k, None]
    enter, leave = cross_slabs([dot(to_box[axis], pieces.direction) for axis in range(3)], list(origin), half)
    return torch.maximum(enter, pieces.near) - torch.minimum(leave, pieces.far)


def cross_slabs(direction: Sequence[Tensor], origin: Sequence[Tensor], half: Sequence[Any]) -> tuple[Tensor, Tensor]:
    """Return where rays enter and leave a box [m], in its axes; rays that miss it leave before they enter.

    Along an axis, with the origin x, the direction d and the half length h, the ray is between the two faces from
    (-x - h) / d to (-x + h) / d, and inside the box where it is between all three pairs (slab method).
    """
    spans = []
    for d, x, h in zip(direction, origin, half, strict=True):
        inverse = 1 / torch.where(d.abs() < _TINY, _TINY, d)  # finite, as 0 * inf would be NaN
        one, other = (-h - x) * inverse, (h - x) * inverse
        spans.append((torch.minimum(one, other), torch.maximum(one, other)))
    (a, b, c), (d, e, f) = zip(*spans, strict=True)
    return torch.maximum(torch.maximum(a, b), c), torch.minimum(torch.minimum(d, e), f)
