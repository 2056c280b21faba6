"""Rays against the robot's own body: the first hit of a capsule or a box, seen from outside."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.robot_body.own_points import cross_slabs
from torchelev.robot_body.posing import PosedBody, dot, pose_body, relative_pose
from torchelev.robot_body.shapes import RobotBody
from torchelev.sim.sensors.tracing import can_select_rays

if TYPE_CHECKING:
    from jaxtyping import Float

MAX_PAIRS = 2**19  # of rays and shapes, worked on at once; a few megabytes per intermediate value
_TINY = 1e-12
_ROUNDING = 1e-7  # of float32


def cast_at_body(
    body: RobotBody,
    T_base_sensor: Float[Tensor, "B 4 4"],
    T_base_links: Float[Tensor, "B K 4 4"],
    directions: Float[Tensor, "B M 3"],
) -> Float[Tensor, "B M"]:
    """Return the distance [m] from a sensor to the first hit of each ray on the body, float32; inf where it hits none.

    Shapes are not padded. A shape that holds the sensor hides nothing from it: cameras are built into housings.
    Distances have no gradient.

    Args:
        body: The shapes.
        T_base_sensor: Poses of the sensor in the base frame.
        T_base_links: Poses of the links in the base frame, in the order of `body.links`.
        directions: Unit vectors, in the sensor's frame.
    """
    B, M = directions.shape[:2]
    chunk = max(1, MAX_PAIRS // max(1, M * (len(body.capsules) + len(body.boxes))))
    parts = [directions.new_empty((0, M), dtype=torch.float32)]
    with torch.no_grad():
        base = torch.eye(4, device=directions.device).expand(B, 4, 4)
        T_sensor_base = relative_pose(T_base_sensor[:, None], base, torch.float32)
        for first in range(0, B, chunk):
            envs = slice(first, first + chunk)
            posed = pose_body(body, T_sensor_base[envs], T_base_links[envs].float())
            parts.append(_cast_part(body, posed, directions[envs].float()))
        return torch.cat(parts)


def _cast_part(body: RobotBody, posed: PosedBody, directions: Float[Tensor, "B M 3"]) -> Float[Tensor, "B M"]:
    nearest = torch.full_like(directions[..., 0], math.inf)
    if body.capsules:
        capsules = _capsules_of(body, posed)
        hit = _hit_near_capsules if can_select_rays(directions.device) else _hit_all_capsules
        nearest = hit(directions, capsules)
    if body.boxes:
        boxes = _hit_boxes(list(directions[:, None].unbind(-1)), posed, body).amin(1)
        nearest = torch.minimum(nearest, boxes)
    return nearest


class _Capsules(NamedTuple):
    """Capsules around the axes from a to a + e, with coordinates first, of any shape that broadcasts with rays."""

    start: Tensor  #: (3, ...) [m] a
    axis: Tensor  #: (3, ...) [m] e
    start_start: Tensor  #: [m^2] a . a
    start_axis: Tensor  #: [m^2] a . e
    length2: Tensor  #: [m^2] e . e
    radius2: Tensor  #: [m^2]


def _capsules_of(body: RobotBody, posed: PosedBody) -> _Capsules:
    """Return the capsules as one sensor sees them, (B, P) each."""
    start, axis, start_start, start_axis = (value.squeeze(-2) for value in posed[:4])
    length2 = _per_shape([capsule.length**2 for capsule in body.capsules], start_start)
    radius2 = _per_shape([capsule.radius**2 for capsule in body.capsules], start_start)
    return _Capsules(start, axis, start_start, start_axis, length2.mT.expand_as(start_start), radius2.mT)


def _hit_all_capsules(directions: Float[Tensor, "B M 3"], capsules: _Capsules) -> Float[Tensor, "B M"]:
    """Return where each ray enters its first capsule [m]."""
    rays = directions[:, None].movedim(-1, 0)  # (3, B, 1, M), against capsules (B, P, 1)
    return _hit_capsules(rays, _Capsules(*(value[..., None] for value in capsules))).amin(1)


def _hit_near_capsules(directions: Float[Tensor, "B M 3"], capsules: _Capsules) -> Float[Tensor, "B M"]:
    """Return the same, computed only for rays that pass through the sphere around a capsule: most pass far away."""
    center = capsules.start + capsules.axis / 2
    reach = capsules.length2.sqrt() / 2 + capsules.radius2.sqrt()
    # A ray passes at |c|^2 - (c . d)^2 from the centre c; kept within 1 %, as float32 rounds.
    min_square = dot(center, center) - (1.01 * reach).square()
    on_center = center.movedim(0, -1) @ directions.mT
    env, shape, ray = (
        ((on_center > -reach[..., None]) & (on_center.square() >= min_square[..., None])).nonzero().unbind(1)
    )
    chosen = _Capsules(*(value.expand_as(center if value.ndim == 3 else reach)[..., env, shape] for value in capsules))
    distance = _hit_capsules(directions.movedim(-1, 0)[:, env, ray], chosen)
    nearest = torch.full_like(directions[..., 0], math.inf)
    nearest.view(-1).scatter_reduce_(0, env * directions.shape[1] + ray, distance, "amin")
    return nearest


def _hit_capsules(rays: Tensor, capsules: _Capsules) -> Tensor:
    """Return where rays (3, ...) enter capsules [m], inf where they do not.

    t d lies on the cylinder of radius r where |t d - a - v e| = r with v the place along the axis: a quadratic equation
    in t. Where v is not in 0 to 1, the ray meets the end's sphere first, |t d - c| = r, if it meets the capsule at all.
    A sensor inside is past the entry: t is negative.
    """
    start, axis, start_start, start_axis, length2, radius2 = capsules
    on_start, on_axis = dot(rays, start), dot(rays, axis)
    # Of a ray along the axis, a is a rounding error: kept above it, the ray meets the cylinder far before its ends.
    a = torch.maximum(length2 - on_axis * on_axis, _ROUNDING * length2 + _TINY)
    b = length2 * on_start - start_axis * on_axis
    c = length2 * (start_start - radius2) - start_axis * start_axis
    t = (b - (b * b - a * c).clamp(min=0).sqrt()) / a
    v = t * on_axis - start_axis
    # The end's sphere, which only counts where its half of the capsule's surface is met.
    at_end = (v > length2 / 2).to(a.dtype)
    along = on_start + at_end * on_axis
    rest = along * along - (start_start + at_end * (2 * start_axis + length2) - radius2)
    on_cap = along - rest.clamp(min=0).sqrt()
    on_side = (v > 0) & (v < length2)
    t = torch.where(on_side, t, on_cap)
    is_met = torch.where(on_side, b * b >= a * c, rest >= 0) & (t > 0)
    return t.masked_fill(~is_met, math.inf)


def _hit_boxes(rays: list[Tensor], posed: PosedBody, body: RobotBody) -> Float[Tensor, "B Q M"]:
    """Return where rays enter boxes [m], inf where they do not."""
    to_box, origin = (value.squeeze(-2)[..., None] for value in (posed.to_box, posed.origin))
    half = [_per_shape([box.half_lengths[axis] for box in body.boxes], origin) for axis in range(3)]
    enter, leave = cross_slabs([dot(to_box[axis], rays) for axis in range(3)], list(origin), half)
    return enter.masked_fill(~((enter <= leave) & (enter > 0)), math.inf)


def _per_shape(values: list[float], like: Tensor) -> Float[Tensor, "P 1"]:
    """Return one number per shape. Filled, not copied from the host, which a GPU would wait for."""
    return torch.stack([like.new_full((1,), value) for value in values])
