"""The quadruped's proprioception: the observation "policy", and "privileged" for the critic."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from envs.quadruped.kinematics import JOINTS
from torchelev.observations.patterns import compute_heading

#: names of the entries of the observation "policy"
ENTRIES = (
    *(f"{name} {axis}" for name in ("velocity [m/s]", "angular velocity [rad/s]", "gravity") for axis in "xyz"),
    *("command ahead [m/s]", "command to the left [m/s]", "command yaw rate [rad/s]"),
    *(f"{name} of {joint}" for name in ("angle [rad]", "velocity [10 rad/s]", "last action") for joint in JOINTS),
    *("gait's sine", "gait's cosine"),
)


def observe_body(
    velocity: Tensor,
    angular_velocity: Tensor,
    gravity: Tensor,
    command: Tensor,
    joints: Tensor,
    joint_velocities: Tensor,
    last_action: Tensor,
    phase: Tensor,
) -> Tensor:
    """Return the observation "policy" (B, 50).

    Its entries are, in this order: estimated velocity of the base (3) [m/s], angular velocity (3) [rad/s] and direction
    of gravity (3), all in the base frame; command (3); joint angles less those of the standing robot (12) [rad]; joint
    velocities (12) [10 rad/s]; last action (12); sine and cosine of the gait's phase (2).
    """
    angle = 2 * math.pi * phase
    clock = torch.stack([angle.sin(), angle.cos()], -1)
    parts = [velocity, angular_velocity, gravity, command, joints, 0.1 * joint_velocities, last_action, clock]
    return torch.cat(parts, -1)


def observe_privileged(velocity: Tensor, stands: Tensor, foot_velocities: Tensor, latency: Tensor) -> Tensor:
    """Return the observation "privileged" (B, 20) of the critic.

    Its entries are: true velocity of the base (3) [m/s], base frame; whether each foot stands (4); velocities of the
    feet (12) [m/s], relative to the ground and in axes of the base too; latency (1) [physics steps]. The feet's are
    those of the sensors' instant, 5 ms earlier, as sensors deliver them.
    """
    parts = [velocity, stands.to(velocity.dtype), foot_velocities.flatten(1), latency[:, None].to(velocity.dtype)]
    return torch.cat(parts, -1)


def rotation_matrix(quat_wxyz: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def to_yaw_frame(vector: Tensor, T_map_base: Tensor) -> Tensor:
    """Return vectors (B, 3) of the map frame in the yaw frame of the base."""
    forward = compute_heading(T_map_base)
    ahead = (vector[:, :2] * forward).sum(-1)
    left = vector[:, 1] * forward[:, 0] - vector[:, 0] * forward[:, 1]
    return torch.stack([ahead, left, vector[:, 2]], -1)
