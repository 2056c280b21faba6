"""The trot that a policy modifies: where each foot should be, and the joint angles that put it there.

Legs come in the order front left, front right, rear left, rear right; joints of a leg as abduction, thigh, knee.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from envs.quadruped.config import GaitConfig

HIPS = ((0.19, 0.055), (0.19, -0.055), (-0.19, 0.055), (-0.19, -0.055))  # [m] abduction axes, base frame
SIDES = (1.0, -1.0, 1.0, -1.0)  # left or right
ABDUCTION = 0.08  # [m] from the abduction axis to the leg's plane
LINK = 0.21  # [m] of thigh and calf
PHASES = (0.0, 0.5, 0.5, 0.0)  # of the legs in a cycle: diagonal pairs


@functools.cache  # making a GPU tensor from a list synchronises with the host
def constants(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return hips (4, 2) [m], sides (4,) and phases (4,) on a device."""
    with torch.inference_mode(False):
        return tuple(torch.tensor(values, device=device) for values in (HIPS, SIDES, PHASES))  # type: ignore[return-value]


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
    hips, sides, phases = constants(phase.device)
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
    return torch.stack([stride[..., 0], nominal + stride[..., 1], lift - cfg.body_height + 0.022], -1)


def joint_angles(feet: Tensor) -> Tensor:
    """Return the joint angles (B, 12) [rad] that put the feet (B, 4, 3) [m], each seen from its abduction axis.

    Abduction turns the leg's plane towards the foot; thigh and knee follow from the law of cosines. A foot out of reach
    is put on the nearest place in its direction.
    """
    x, y, z = feet.unbind(-1)
    side = constants(feet.device)[1] * ABDUCTION
    depth = (y.square() + z.square() - ABDUCTION**2).clamp(min=0.05**2).sqrt()  # in the leg's plane
    abduction = torch.atan2(z, y) - torch.atan2(-depth, side.expand_as(y))
    abduction = torch.remainder(abduction + math.pi, 2 * math.pi) - math.pi
    distance2 = x.square() + depth.square()
    cos_knee = ((distance2 - 2 * LINK**2) / (2 * LINK**2)).clamp(-0.9, 0.98)
    knee = -torch.acos(cos_knee)
    thigh = torch.atan2(-x, depth) - torch.atan2(LINK * torch.sin(knee), LINK * (1 + torch.cos(knee)))
    return torch.stack([abduction, thigh, knee], -1).flatten(1)


def feet_from_joints(angles: Tensor) -> Tensor:
    """Return the feet (B, 4, 3) [m], each seen from its abduction axis, of joint angles (B, 12) [rad]."""
    abduction, thigh, knee = angles.unflatten(-1, (4, 3)).unbind(-1)
    side = constants(angles.device)[1] * ABDUCTION
    x = -LINK * (torch.sin(thigh) + torch.sin(thigh + knee))
    down = -LINK * (torch.cos(thigh) + torch.cos(thigh + knee))
    cos, sin = torch.cos(abduction), torch.sin(abduction)
    return torch.stack([x, cos * side - sin * down, sin * side + cos * down], -1)
