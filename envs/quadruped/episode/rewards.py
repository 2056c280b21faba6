"""The reward of a step, as a sum of weighted terms."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from envs.quadruped.config import RewardConfig


class Motion(NamedTuple):
    """The quantities in the reward of a step, for B robots."""

    velocity: Tensor  #: (B, 3) [m/s] of the base, yaw frame
    angular_velocity: Tensor  #: (B, 3) [rad/s] base frame
    gravity: Tensor  #: (B, 3) direction of gravity, base frame
    command: Tensor  #: (B, 3) velocity ahead and to the left [m/s], yaw rate [rad/s]
    torques: Tensor  #: (B, 12) [N m]
    joint_acceleration: Tensor  #: (B, 12) [rad/s^2]
    action: Tensor  #: (B, 12)
    last_action: Tensor  #: (B, 12)
    touches: Tensor  #: (B, 13) whether each link touched the ground, feet not counted
    foot_speed: Tensor  #: (B, 4) [m/s] horizontal
    stands: Tensor  #: (B, 4) bool, whether each foot touches the ground
    fallen: Tensor  #: (B,) bool


def terms(m: Motion, sigma: float) -> dict[str, Tensor]:
    """Return each term (B,) before weighting, by its name in `RewardConfig`.

    With the velocity v and yaw rate w_z, the command c, the direction of gravity g, joint torques tau, joint velocities
    q', the action a, and v_f the horizontal velocity of each foot f that stands:

    - linear_velocity: exp(-|c_xy - v_xy|^2 / sigma^2)
    - yaw_rate: exp(-(c_w - w_z)^2 / sigma^2)
    - vertical_velocity: v_z^2
    - roll_pitch_rate: w_x^2 + w_y^2
    - orientation: g_x^2 + g_y^2
    - torque: |tau|^2
    - joint_acceleration: |q'' |^2
    - action_rate: |a - a_before|^2
    - action: |a|^2
    - collision: number of links that touch the ground
    - slip: sum over f of |v_f|^2
    - fall: 1 if the robot has fallen
    """
    return {
        "linear_velocity": torch.exp(-_square(m.command[:, :2] - m.velocity[:, :2]) / sigma**2),
        "yaw_rate": torch.exp(-(m.command[:, 2] - m.angular_velocity[:, 2]).square() / sigma**2),
        "vertical_velocity": m.velocity[:, 2].square(),
        "roll_pitch_rate": _square(m.angular_velocity[:, :2]),
        "orientation": _square(m.gravity[:, :2]),
        "torque": _square(m.torques),
        "joint_acceleration": _square(m.joint_acceleration),
        "action_rate": _square(m.action - m.last_action),
        "action": _square(m.action),
        "collision": m.touches.sum(-1),
        "slip": (m.foot_speed.square() * m.stands).sum(-1),
        "fall": m.fallen.to(m.velocity.dtype),
    }


def reward(m: Motion, cfg: RewardConfig, dt: float) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the reward (B,) of a step of `dt` [s], and its weighted terms.

    The sum of weight * term * dt, but at least 0, as in legged_gym: otherwise a robot that moves badly would do best to
    fall early. A fall counts once, and is added after that.
    """
    weighted = {
        name: getattr(cfg, name) * value * (1.0 if name == "fall" else dt)
        for name, value in terms(m, cfg.tracking_sigma).items()
    }
    moving = torch.stack([value for name, value in weighted.items() if name != "fall"]).sum(0)
    return moving.clamp(min=0.0) + weighted["fall"], weighted


def _square(values: Tensor) -> Tensor:
    return values.square().sum(-1)
