"""A trotting gait: footholds on the ground, and hip, knee and foot of each leg."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from docs.moving_picture.walk import Path

HIPS = np.array([[0.26, 0.17], [0.26, -0.17], [-0.26, 0.17], [-0.26, -0.17]])  # [m] base frame, front left first
_PHASE = (0.0, 0.5, 0.5, 0.0)  # diagonal legs step together
_CYCLE, _STANCE = 0.62, 0.58  # [s], and the part of it in which a foot stands
_LIFT = 0.09  # [m]
_LINK = 0.30  # [m] length of thigh and of shank


def leg_joints(path: Path, seconds: float) -> list[tuple[NDArray, NDArray, NDArray]]:
    """Return hip, knee and foot (3,) [m] of the four legs in the map frame at a time [s]."""
    T = path.base(seconds)
    joints = []
    for hip, phase in zip(HIPS, _PHASE, strict=True):
        top = T[:3, :3] @ [*hip, -0.04] + T[:3, 3]
        foot = _foot(path, hip, phase, seconds)
        joints.append((top, _knee(top, foot, T[:3, 0]), foot))
    return joints


def _foot(path: Path, hip: NDArray, phase: float, seconds: float) -> NDArray:
    """Return the foot (3,) [m]: on its foothold in stance, on an arc to the next one in swing."""
    step, part = divmod(seconds / _CYCLE + phase, 1.0)
    here = _foothold(path, hip, (step - phase + _STANCE / 2) * _CYCLE)
    if part < _STANCE:
        return here
    there = _foothold(path, hip, (step + 1 - phase + _STANCE / 2) * _CYCLE)
    swing = (part - _STANCE) / (1 - _STANCE)
    ease = (1 - math.cos(math.pi * swing)) / 2
    arc = _LIFT + abs(there[2] - here[2]) / 2
    return here + ease * (there - here) + [0, 0, arc * math.sin(math.pi * swing)]


def _foothold(path: Path, hip: NDArray, seconds: float) -> NDArray:
    """Return where the foot stands (3,) [m]: below its hip at the middle of the stance."""
    T = path.base(min(max(seconds, 0.0), path.seconds))
    xy = (T[:3, :3] @ [*hip, 0.0] + T[:3, 3])[:2]
    return np.array([*xy, float(path.ground(xy))])


def _knee(hip: NDArray, foot: NDArray, forward: NDArray) -> NDArray:
    """Return the knee (3,) [m] by inverse kinematics; it points backwards."""
    leg = foot - hip
    length = float(np.linalg.norm(leg))
    bend = math.sqrt(max(_LINK**2 - length**2 / 4, 0.0))
    back = -forward + (forward @ leg) * leg / length**2
    return hip + leg / 2 + bend * back / np.linalg.norm(back)
