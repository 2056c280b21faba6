"""A quadruped that trots over flat ground by its kinematics alone, and what its two cameras see.

Links: the base, and of each leg hip, thigh and shank. Sizes are those of a robot of about 12 kg.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.robot_body import Box, Capsule, RobotBody
from torchelev.sim import DepthCamera, HeightField, MountedSensor, mount
from torchelev.sim.poses import pose

LEGS = {"front_left": (1, 1), "front_right": (1, -1), "rear_left": (-1, 1), "rear_right": (-1, -1)}
HIP_X, HIP_Y, HIP_LENGTH = 0.19, 0.05, 0.08  # [m]
THIGH = SHANK = 0.21  # [m] from joint to joint, and from the knee to the middle of the foot
FOOT_RADIUS = 0.022  # [m]
HEIGHT = 0.3  # [m] of the hips over the middles of standing feet
STRIDE, LIFT = 0.16, 0.08  # [m]
PERIOD = 0.5  # [s] of a step of both diagonals
MOUNTS = [mount(75.0, 0.28, 0.06), mount(75.0, -0.28, 0.06, yaw_deg=180.0)]


def make_cameras(width: int = 20, height: int = 15) -> list[MountedSensor]:
    """Return depth cameras at both ends of the trunk that look down at the feet."""
    return [MountedSensor(DepthCamera(width=width, height=height, max_range=4.0), T) for T in MOUNTS]


def make_body(**options: float) -> RobotBody:
    """Return the robot's 13 links as a box and 16 capsules; the options are those of `RobotBody`."""
    capsules = []
    for leg, (_, side) in LEGS.items():
        foot = (0.0, 0.0, -SHANK)
        capsules += [
            Capsule(link=f"{leg}_hip", start=(0.0, 0.0, 0.0), end=(0.0, side * HIP_LENGTH, 0.0), radius=0.045),
            Capsule(link=f"{leg}_thigh", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, -THIGH), radius=0.025),
            Capsule(link=f"{leg}_shank", start=(0.0, 0.0, 0.0), end=foot, radius=0.015),
            Capsule(link=f"{leg}_shank", start=foot, end=foot, radius=FOOT_RADIUS),
        ]
    trunk = Box(link="base", center=(0.0, 0.0, 0.0), half_lengths=(0.25, 0.1, 0.05))
    return RobotBody(capsules=tuple(capsules), boxes=(trunk,), **options)


def _leg(x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the angles [rad] about y of thigh and shank, whose foot is then at (x, z) under the hip."""
    reach = torch.hypot(x, z)
    knee = torch.acos(((reach**2 - THIGH**2 - SHANK**2) / (2 * THIGH * SHANK)).clamp(-1, 1))
    thigh = torch.atan2(-x, -z) + torch.atan2(SHANK * knee.sin(), THIGH + SHANK * knee.cos())
    return thigh, thigh - knee


def link_poses(phase: Tensor, links: tuple[str, ...]) -> Tensor:
    """Return T_base_links (B, K, 4, 4) float64 at these phases (B,) of a trot, in 0 to 1: a stance, then a swing."""
    still, level = torch.zeros(len(phase), 3, dtype=torch.float64), torch.zeros(len(phase))
    T = {"base": pose(still, level)}
    for leg, (fore, side) in LEGS.items():
        of_leg = (phase.double() + (0.0 if fore == side else 0.5)) % 1
        swing = (2 * of_leg - 1).clamp(min=0)
        x = torch.where(of_leg < 0.5, 0.5 - 2 * of_leg, -0.5 * torch.cos(math.pi * swing)) * STRIDE
        thigh, shank = _leg(x, LIFT * torch.sin(math.pi * swing) - HEIGHT)
        hip = still + torch.tensor([fore * HIP_X, side * HIP_Y, 0.0])
        T[f"{leg}_hip"] = pose(hip, level)
        T[f"{leg}_thigh"] = pose(hip + torch.tensor([0.0, side * HIP_LENGTH, 0.0]), level, thigh)
        knee = T[f"{leg}_thigh"] @ torch.tensor([0.0, 0.0, -THIGH, 1.0], dtype=torch.float64)
        T[f"{leg}_shank"] = pose(knee[:, :3], level, shank)
    return torch.stack([T[link] for link in links], 1)


class Scan(NamedTuple):
    """Clouds of the cameras of B robots at one instant, and the poses."""

    points: Tensor  #: (B, 2, N, 3) [m] sensor frames, exact
    on_body: Tensor  #: (B, 2, N) bool, the points on the robot itself
    T_map_sensor: Tensor  #: (B, 2, 4, 4)
    T_map_base: Tensor  #: (B, 4, 4)
    T_base_links: Tensor  #: (B, 13, 4, 4)


def walk(robots: int, scans: int, cameras: list[MountedSensor], seed: int = 0) -> list[Scan]:
    """Return scans of robots that trot ahead over flat ground, a tenth of a second apart, each with its own phase."""
    generator = torch.Generator().manual_seed(seed)
    field, tiles = HeightField(torch.zeros(1, 100, 100), 0.1), torch.zeros(robots, dtype=torch.int64)
    body, start = make_body(), torch.rand(robots, generator=generator, dtype=torch.float64)
    position = torch.tensor([0.0, 0.0, HEIGHT + FOOT_RADIUS], dtype=torch.float64).repeat(robots, 1)
    seen = []
    for k in range(scans):
        position[:, 0] = 0.1 * k * 2 * STRIDE / PERIOD
        T_map_base = pose(position, torch.zeros(robots))
        T_base_links = link_poses((start + 0.1 * k / PERIOD) % 1, body.links)
        views = [c.view(field, tiles, T_map_base, body=body, T_base_links=T_base_links) for c in cameras]
        T_map_sensor = torch.stack([camera.T_map_sensor(T_map_base) for camera in cameras], 1)
        points, on_body = torch.stack([v.points for v in views], 1), torch.stack([v.on_body for v in views], 1)
        seen.append(Scan(points, on_body, T_map_sensor, T_map_base, T_base_links))
    return seen
