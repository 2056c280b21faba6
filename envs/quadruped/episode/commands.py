"""The commands that robots follow: velocities and headings, drawn anew from time to time (legged_gym)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from envs.quadruped.config import CommandConfig
from torchelev.observations.patterns import compute_heading


def draw_commands(u: Tensor, heading: Tensor, cfg: CommandConfig) -> tuple[Tensor, Tensor]:
    """Return new commands (B, 3), whose yaw rate is left to `yaw_rate`, and headings (B,) [rad].

    Args:
        u: (4, B), random numbers from 0 to 1.
        heading: the headings until now (B,) [rad].
        cfg: the settings.
    """
    moves = (u[3] >= cfg.standing).float()
    ahead, left = (low + (high - low) * x for (low, high), x in ((cfg.forward, u[0]), (cfg.left, u[1])))
    command = torch.stack([ahead * moves, left * moves, torch.zeros_like(ahead)], -1)
    return command, heading + cfg.heading * (2 * u[2] - 1)


def yaw_rate(command: Tensor, heading: Tensor, T_map_base: Tensor, cfg: CommandConfig) -> Tensor:
    """Return the yaw rate (B,) [rad/s] that turns robots to their heading; 0 for those that are to stand."""
    forward = compute_heading(T_map_base)
    error = heading - torch.atan2(forward[:, 1], forward[:, 0])
    error = torch.remainder(error + math.pi, 2 * math.pi) - math.pi
    rate = (cfg.heading_gain * error).clamp(-cfg.max_yaw_rate, cfg.max_yaw_rate)
    stands = (command[:, :2].abs().amax(-1) == 0).float()
    return rate * (1 - stands)
