"""Where the robot is: rigid poses in float64, along a path over a scene, and what a drifting estimator reports.

Base frame: x forward, y left, z up. Sensor frame: the same axes, at the mount, pitched down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.sim.exact.scenes import Scene
from torchelev.sim.poses import MOUNT, pose

Point = tuple[float, float]


class Trajectory(NamedTuple):
    """A robot's path, T instants."""

    T_map_base: Tensor  #: (T, 4, 4) float64
    T_map_sensor: Tensor  #: (T, 4, 4) float64
    times: Tensor  #: (T,) [s]

    def then(self, other: Trajectory) -> Trajectory:
        """Join two paths; the second starts one step after the first ends."""
        step = self.times[-1] - self.times[-2]
        return Trajectory(
            torch.cat([self.T_map_base, other.T_map_base]),
            torch.cat([self.T_map_sensor, other.T_map_sensor]),
            torch.cat([self.times, other.times - other.times[0] + self.times[-1] + step]),
        )


def turn_on_the_spot(
    height: float = 0.8,
    n: int = 36,
    *,
    scene: Scene | None = None,
    at: Point = (0.0, 0.0),
    turns: float = 1.0,
    dt: float = 0.1,
    T_base_sensor: Tensor = MOUNT,
) -> Trajectory:
    """Return n poses that turn left at one place, the sensor's mount `height` [m] over the ground of `scene` there."""
    ground = 0.0 if scene is None else float(scene.truth(torch.tensor(at)))
    base = torch.tensor([*at, ground + height - float(T_base_sensor[2, 3])], dtype=torch.float64).expand(n, 3)
    T_map_base = pose(base, turns * 2 * math.pi * torch.arange(n, dtype=torch.float64) / n)
    return Trajectory(T_map_base, T_map_base @ T_base_sensor, dt * torch.arange(n, dtype=torch.float64))


def walk(
    scene: Scene,
    path: Sequence[Point],
    *,
    speed: float = 0.6,
    dt: float = 0.1,
    height: float = 0.55,
    sway: float = 1.0,
    below: float = math.inf,
    T_base_sensor: Tensor = MOUNT,
) -> Trajectory:
    """Return poses of a legged robot that walks along the corners `path` at `speed` [m/s], one each `dt` [s].

    It turns on the spot at corners (1 rad/s). The base keeps `height` [m] over the ground averaged under its feet and
    pitches and rolls with it; on top come gait bob (+-1.5 cm), roll and pitch (+-2 deg), times `sway`. `below` [m] is
    passed to the scene's height: which floor of a building it walks on.
    """
    xy, yaw = _along(path, speed * dt, dt)
    T = len(yaw)
    times = dt * torch.arange(T, dtype=torch.float64)
    ground, pitch, roll = _footing(scene, xy, yaw, below)
    phase = 2 * math.pi * 1.5 * times  # 1.5 strides a second
    two_degrees = math.radians(2.0)
    z = ground + height + sway * 0.015 * (2 * phase).sin()
    pitch, roll = pitch + sway * two_degrees * (2 * phase + 0.7).sin(), roll + sway * two_degrees * phase.sin()
    T_map_base = pose(torch.cat([xy, z[:, None]], -1), yaw, pitch, roll)
    return Trajectory(T_map_base, T_map_base @ T_base_sensor, times)


def _along(path: Sequence[Point], stride: float, dt: float) -> tuple[Tensor, Tensor]:
    """Sample the path: places (T, 2) [m] and headings (T,) [rad]."""
    corners = torch.tensor(path, dtype=torch.float64)
    legs = corners[1:] - corners[:-1]
    headings = torch.atan2(legs[:, 1], legs[:, 0]).tolist()
    places, yaws = [corners[:1]], [torch.tensor([headings[0]], dtype=torch.float64)]
    for k, (leg, heading) in enumerate(zip(legs, headings, strict=True)):
        before = float(yaws[-1][-1])
        turn = math.remainder(heading - before, 2 * math.pi)
        count = math.ceil(abs(turn) / dt - 1e-9)
        share = torch.arange(1, count + 1, dtype=torch.float64) / max(count, 1)
        places.append(corners[k].expand(count, 2))
        yaws.append(before + turn * share)
        count = max(1, round(float(leg.norm()) / stride))
        share = torch.arange(1, count + 1, dtype=torch.float64) / count
        places.append(corners[k] + share[:, None] * leg)
        yaws.append(torch.full((count,), before + turn, dtype=torch.float64))
    return torch.cat(places), torch.cat(yaws)


def _footing(scene: Scene, xy: Tensor, yaw: Tensor, below: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the ground's mean height, pitch and roll (T,) under a footprint of 0.7 x 0.4 m."""
    forward = torch.linspace(-0.35, 0.35, 8, dtype=torch.float64)
    left = torch.linspace(-0.2, 0.2, 4, dtype=torch.float64)
    f, s = (a.reshape(-1) for a in torch.meshgrid(forward, left, indexing="ij"))
    c, d = yaw.cos()[:, None], yaw.sin()[:, None]
    x, y = xy[:, :1] + c * f - d * s, xy[:, 1:] + d * f + c * s
    z = scene.height(x, y, 0.0, below)
    slope_forward, slope_left = z @ f / f.square().sum(), z @ s / s.square().sum()
    return z.mean(-1), -slope_forward.atan(), slope_left.atan()


def sink(poses: Tensor, total: float = 0.15) -> Tensor:
    """Return poses (T, 4, 4) as an estimator that loses height evenly reports them: the last is `total` [m] too low.

    Cast with the true poses, map with these.
    """
    drifted = poses.clone()
    drifted[:, 2, 3] -= total * torch.linspace(0, 1, len(poses), dtype=poses.dtype)
    return drifted
