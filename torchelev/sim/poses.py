"""Rigid transforms from angles, and where sensors sit on a robot.

Base frame: x forward, y left, z up. Sensor frame: the same axes, moved to the sensor, turned and pitched down.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


def pose(
    position: Float[Tensor, "*B 3"],
    yaw: Float[Tensor, "*B"] | float,
    pitch: Float[Tensor, "*B"] | float = 0.0,
    roll: Float[Tensor, "*B"] | float = 0.0,
) -> Float[Tensor, "*B 4 4"]:
    """Return the transform with rotation R = Rz(yaw) Ry(pitch) Rx(roll), float64.

    Args:
        position: Origin of the frame [m].
        yaw: Heading [rad]; positive turns left.
        pitch: [rad]; positive turns the nose down.
        roll: [rad]; positive lowers the right side.
    """
    angles = torch.broadcast_tensors(*(torch.as_tensor(a, dtype=torch.float64) for a in (yaw, pitch, roll)))
    (cy, cp, cr), (sy, sp, sr) = [a.cos() for a in angles], [a.sin() for a in angles]
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    T = torch.eye(4, dtype=torch.float64).repeat(*cy.shape, 1, 1)
    T[..., :3, :3] = torch.stack([torch.stack(row, -1) for row in rows], -2)
    T[..., :3, 3] = position
    return T


def pose_from_rotation_vector(vector: Float[Tensor, "B 3"], position: Float[Tensor, "B 3"]) -> Float[Tensor, "B 4 4"]:
    """Return the transform of a rotation vector [rad] and a position [m], by Rodrigues' formula.

    With angle a = |vector| and K the cross-product matrix of the vector, R = 1 + sin(a)/a K + (1 - cos(a))/a^2 K^2.
    """
    x, y, z = vector.unbind(-1)
    zero, angle = torch.zeros_like(x), torch.linalg.vector_norm(vector, dim=-1)[:, None, None]
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
    T = torch.eye(4, dtype=vector.dtype, device=vector.device).repeat(len(vector), 1, 1)
    # sinc keeps both factors finite at an angle of 0, where they are 1 and 1/2.
    sine, cosine = torch.sinc(angle / math.pi), torch.sinc(angle / (2 * math.pi)).square() / 2
    T[:, :3, :3] += sine * K + cosine * K @ K
    T[:, :3, 3] = position
    return T


def mount(
    pitch_deg: float = 35.0, x: float = 0.0, z: float = 0.25, *, y: float = 0.0, yaw_deg: float = 0.0
) -> Float[Tensor, "4 4"]:
    """Return T_base_sensor of a sensor at (x, y, z) [m] in the base frame, float64.

    Args:
        pitch_deg: How far the sensor looks down [deg].
        x: Distance ahead of the base [m].
        z: Height over the base [m].
        y: Distance to the left of the base [m].
        yaw_deg: Heading of the sensor from straight ahead, positive to the left [deg].
    """
    return pose(torch.tensor([x, y, z], dtype=torch.float64), math.radians(yaw_deg), math.radians(pitch_deg))


def mount_on_rim(
    length: float, width: float, yaw_deg: float, pitch_deg: float, z: float = 0.05
) -> Float[Tensor, "4 4"]:
    """Return T_base_sensor of a sensor on the rim of a robot's body that looks outwards and down, float64.

    The rim is the ellipse with axes `length` and `width`.

    Args:
        length: Length of the body [m].
        width: Width of the body [m].
        yaw_deg: Heading of the sensor, and where on the rim it sits: 0 ahead, positive to the left [deg].
        pitch_deg: How far the sensor looks down [deg].
        z: Height over the base [m].
    """
    yaw = math.radians(yaw_deg)
    return mount(pitch_deg, length / 2 * math.cos(yaw), z, y=width / 2 * math.sin(yaw), yaw_deg=yaw_deg)


MOUNT = mount()  #: T_base_sensor (4, 4) of the default mounting: 0.25 m over the base, pitched down by 35 degrees
