"""The quadruped's legs: where feet and links are at given joint angles, and the angles that put a foot somewhere.

Legs come in the order front left, front right, rear left, rear right; joints of a leg as abduction, thigh, knee.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from xml.etree import ElementTree

import torch
from torch import Tensor

from torchelev.frames.arrays import assemble

ROBOT = Path(__file__).with_name("robot.xml")
LEGS = ("FL", "FR", "RL", "RR")
LINKS = ("base", *(f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh", "calf")))
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("abduction", "thigh", "knee"))
HIPS = ((0.19, 0.055), (0.19, -0.055), (-0.19, 0.055), (-0.19, -0.055))  # [m] abduction axes, base frame
SIDES = (1.0, -1.0, 1.0, -1.0)  # left or right
ABDUCTION = 0.08  # [m] from the abduction axis to the leg's plane
LINK = 0.21  # [m] of thigh and calf
FOOT_RADIUS = 0.022  # [m]


@functools.cache  # making a GPU tensor from a list synchronises with the host
def leg_constants(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the hips (4, 3) [m], base frame, and the legs' sides (4,), 1 or -1, on a device."""
    with torch.inference_mode(False):
        hips, sides = torch.tensor(HIPS, device=device), torch.tensor(SIDES, device=device)
        return torch.nn.functional.pad(hips, (0, 1)), sides


@functools.cache
def _ranges() -> dict[str, tuple[float, float]]:
    """Return the limits (low, high) [rad] of abduction, thigh and knee in `robot.xml`."""
    defaults = ElementTree.parse(ROBOT).getroot().iterfind("default/default[joint]")
    texts = {default.attrib["class"]: default.find("joint").get("range", "") for default in defaults}  # type: ignore[union-attr]
    low_high = {name: text.split() for name, text in texts.items()}
    return {name: (float(low), float(high)) for name, (low, high) in low_high.items()}


@functools.cache
def joint_limits(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest angle (12,) [rad] of each joint, on a device."""
    with torch.inference_mode(False):
        ranges = torch.tensor([_ranges()[joint.split("_")[1]] for joint in JOINTS], device=device)
        return ranges[:, 0], ranges[:, 1]


def joint_angles(feet: Tensor) -> Tensor:
    """Return the joint angles (B, 12) [rad] that put the feet (B, 4, 3) [m], each seen from its abduction axis.

    Abduction turns the leg's plane towards the foot; thigh and knee follow from the law of cosines. Angles keep to the
    joints' limits: a foot that the knee cannot reach is put on the nearest place in its direction.
    """
    x, y, z = feet.unbind(-1)
    side = leg_constants(feet.device)[1] * ABDUCTION
    ranges = _ranges()
    depth = (y.square() + z.square() - ABDUCTION**2).clamp(min=0.05**2).sqrt()  # in the leg's plane
    abduction = torch.atan2(z, y) - torch.atan2(-depth, side.expand_as(y))
    abduction = (torch.remainder(abduction + math.pi, 2 * math.pi) - math.pi).clamp(*ranges["abduction"])
    depth = (torch.sin(abduction) * y - torch.cos(abduction) * z).clamp(min=0.05)  # in the plane within its limits
    min_knee, max_knee = ranges["knee"]  # negative: the lowest angle folds the leg
    distance2 = x.square() + depth.square()
    cos_knee = ((distance2 - 2 * LINK**2) / (2 * LINK**2)).clamp(math.cos(min_knee), math.cos(max_knee))
    knee = -torch.acos(cos_knee)
    thigh = torch.atan2(-x, depth) - torch.atan2(LINK * torch.sin(knee), LINK * (1 + torch.cos(knee)))
    return torch.stack([abduction, thigh.clamp(*ranges["thigh"]), knee], -1).flatten(1)


def feet_from_joints(angles: Tensor) -> Tensor:
    """Return the feet (B, 4, 3) [m], each seen from its abduction axis, of joint angles (B, 12) [rad]."""
    abduction, thigh, knee = angles.unflatten(-1, (4, 3)).unbind(-1)
    side = leg_constants(angles.device)[1] * ABDUCTION
    x = -LINK * (torch.sin(thigh) + torch.sin(thigh + knee))
    down = -LINK * (torch.cos(thigh) + torch.cos(thigh + knee))
    cos, sin = torch.cos(abduction), torch.sin(abduction)
    return torch.stack([x, cos * side - sin * down, sin * side + cos * down], -1)


def feet_in_base(angles: Tensor) -> Tensor:
    """Return the feet (B, 4, 3) [m] in the base frame of joint angles (B, 12) [rad]."""
    return feet_from_joints(angles) + leg_constants(angles.device)[0]


def link_poses(angles: Tensor) -> Tensor:
    """Return the poses (B, 13, 4, 4) of the links in the base frame, in the order of LINKS, of joint angles (B, 12)."""
    abduction, thigh, knee = angles.unflatten(-1, (4, 3)).unbind(-1)
    hips, sides = leg_constants(angles.device)
    zero = torch.zeros_like(thigh)
    hip = assemble(hips.expand(*thigh.shape, 3), _turn_x(abduction))
    to_thigh = torch.stack([zero, (ABDUCTION * sides).expand_as(zero), zero], -1)
    upper = hip @ assemble(to_thigh, _turn_y(thigh))
    lower = upper @ assemble(torch.stack([zero, zero, zero - LINK], -1), _turn_y(knee))
    base = torch.eye(4, dtype=angles.dtype, device=angles.device).expand(len(angles), 1, 4, 4)
    return torch.cat([base, torch.stack([hip, upper, lower], 2).flatten(1, 2)], 1)


def _turn_x(angle: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) about x."""
    cos, sin, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([one, zero, zero, zero, cos, -sin, zero, sin, cos], -1).unflatten(-1, (3, 3))


def _turn_y(angle: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) about y."""
    cos, sin, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], -1).unflatten(-1, (3, 3))
