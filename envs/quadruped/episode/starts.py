"""Where and how the robots of new episodes stand."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from envs.quadruped.config import QuadrupedConfig
from envs.quadruped.gait import foot_positions
from envs.quadruped.kinematics import joint_angles


class Starts(NamedTuple):
    """The starts of n robots."""

    phase: Tensor  #: (n,) of the gait
    yaw: Tensor  #: (n,) [rad]
    qpos: Tensor  #: (n, 19) position, orientation and joint angles
    bodies: Tensor  #: (n,) which of the random bodies


def draw_starts(u: Tensor, origins: Tensor, cfg: QuadrupedConfig) -> Starts:
    """Put robots near the middle of their tile, standing, at any heading.

    Args:
        u: (5, n), random numbers from 0 to 1.
        origins: (n, 2) [m] of the tiles.
        cfg: the settings.
    """
    n = u.shape[1]
    phase = torch.where(u[0] < 0.5, 0.0, 0.5)
    yaw, offset = (2 * u[1] - 1) * math.pi, 0.6 * (u[2:4] - 0.5)
    qpos = torch.zeros(n, 19, dtype=torch.float64)
    qpos[:, :2] = origins + offset.t()
    qpos[:, 2] = cfg.gait.body_height + 0.02
    qpos[:, 3], qpos[:, 6] = torch.cos(yaw / 2), torch.sin(yaw / 2)
    qpos[:, 7:] = joint_angles(foot_positions(phase, torch.zeros(n, 3), cfg.gait))
    bodies = (u[4] * cfg.random.num_bodies).long().clamp(max=cfg.random.num_bodies - 1)
    return Starts(phase, yaw, qpos, bodies)
