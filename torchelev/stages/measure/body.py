"""Which points lie on the robot itself: in one box that turns with the base, or on the shapes of its links."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.robot_body.own_points import find_own_points
from torchelev.robot_body.posing import pose_body, relative_pose
from torchelev.robot_body.shapes import RobotBody
from torchelev.stages.measure.config import BodyConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def rotate(rotation: Float[Tensor, "... 3 3"], x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Return the rows of R p. Written out: a matrix product may round otherwise for another batch size."""
    entries = rotation.flatten(-2).unsqueeze(-2).unbind(-1)
    return [a * x + b * y + c * z for a, b, c in (entries[:3], entries[3:6], entries[6:])]


def inside_body(points: Float[Tensor, "B M 3"], T_map_base: Tensor, base: Tensor, body: BodyConfig) -> Tensor:
    """Return which points lie in the robot's body box, which turns with the base."""
    to_base = T_map_base[:, :3, :3].to(points.dtype).transpose(1, 2)
    in_base = rotate(to_base, *(points - base[:, None]).unbind(-1))
    inside = torch.ones_like(in_base[0], dtype=torch.bool)
    for axis, coordinate in enumerate(in_base):
        inside = inside & (coordinate >= body.lower[axis]) & (coordinate <= body.upper[axis])
    return inside


def on_robot(
    x: Float[Tensor, "B S N"],
    y: Tensor,
    z: Tensor,
    distance2: Float[Tensor, "B S N"],
    T_map_sensor: Float[Tensor, "B S 4 4"],
    T_map_base: Float[Tensor, "B 4 4"],
    T_base_links: Float[Tensor, "B K 4 4"],
    body: RobotBody,
) -> Bool[Tensor, "B S N"]:
    """Return which points of the sensors' frames lie on the robot's links, see `RobotBody`.

    The links are posed in the base frame, so that an error of the base's pose, which the sensors share, cancels.
    """
    T_sensor_base = relative_pose(T_map_sensor, T_map_base, x.dtype)
    posed = pose_body(body, T_sensor_base, T_base_links.to(x.dtype))
    return find_own_points(x, y, z, distance2, posed, body)
