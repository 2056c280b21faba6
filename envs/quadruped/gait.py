"""The trot that a policy modifies: where each foot should be."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from envs.quadruped.config import GaitConfig
from envs.quadruped.kinematics import ABDUCTION, FOOT_RADIUS, joint_angles, leg_constants

PHASES = (0.0, 0.5, 0.5, 0.0)  # of the legs in a cycle: diagonal pairs


@functools.cache  # making a GPU tensor from a list synchronises with the host
def _phases(device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(PHASES, device=device)


def foot_positions(phase: Tensor, command: Tensor, cfg: GaitConfig) -> Tensor:
    """Return the feet of the trot (B, 4, 3) [m], each from its abduction axis, in axes of the base.

    A foot at the place r of the base's plane moves with the ground at -(v + w x r) while it stands, and returns on a
    cycloid-like curve: with s from 0 to 1 in the swing, z = h sin(pi s)^2, and along the stride -cos(pi s) / 2. A robot
    that is asked to stand does not lift its feet.

    Args:
        phase: Clock of each robot (B,), from 0 to 1.
        command: Velocity ahead and to the left [m/s] and yaw rate [rad/s] (B, 3).
        cfg: The trot.
    """
    hips, sides = leg_constants(phase.device)
    phases = _phases(phase.device)
    leg = (phase[:, None] + phases).remainder(1.0)
    stands = leg < cfg.duty
    stance, swing = leg / cfg.duty, (leg - cfg.duty) / (1 - cfg.duty)
    # From 1/2 ahead to 1/2 behind while the foot stands, and back in the air.
    along = torch.where(stands, 0.5 - stance, -0.5 * torch.cos(math.pi * swing))
    moves = (command.abs().amax(-1) > 0.05).to(phase.dtype)[:, None]
    lift = torch.where(stands, 0.0, torch.sin(math.pi * swing).square()) * cfg.swing_height * moves
    x, y = hips[:, 0], hips[:, 1] + sides * ABDUCTION
    velocity = torch.stack([command[:, :1] - command[:, 2:] * y, command[:, 1:2] + command[:, 2:] * x], -1)
    stride = velocity * (cfg.duty / cfg.frequency * along * moves)[..., None]
    nominal = (sides * ABDUCTION).expand_as(lift)
    return torch.stack([stride[..., 0], nominal + stride[..., 1], lift - cfg.body_height + FOOT_RADIUS], -1)


def joint_targets(action: Tensor, phase: Tensor, command: Tensor, cfg: GaitConfig) -> Tensor:
    """Return the joint angles (B, 12) [rad] that an action asks for, in the order of `kinematics.JOINTS`.

    Args:
        action: Displacements of the feet (B, 12), leg by leg along x, y and z, in units of `action_scale`.
        phase: Clock of each robot (B,), already at the end of the step.
        command: Velocity ahead and to the left [m/s] and yaw rate [rad/s] (B, 3).
        cfg: The trot.
    """
    limited = action.clamp(-cfg.max_action, cfg.max_action).unflatten(-1, (4, 3))
    scale = torch.tensor(cfg.action_scale, device=action.device)
    return joint_angles(foot_positions(phase, command, cfg) + limited * scale)
