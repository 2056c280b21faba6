"""Robot trajectories over a scene as rigid poses in float64, and the drift of an estimator."""

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
    """Poses of a robot at T instants."""

    T_map_base: Tensor  #: (T, 4, 4) float64, poses of the base
    T_map_sensor: Tensor  #: (T, 4, 4) float64, poses of the sensor
    times: Tensor  #: (T,) [s]

    def then(self, other: Trajectory) -> Trajectory:
        """Append a trajectory, which starts one time step after this one ends."""
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
    """Return the trajectory of a robot that turns left on the spot.

    Args:
        height: Height of the sensor over the ground [m].
        n: Number of poses.
        scene: The ground; None is flat ground at z = 0.
        at: x and y of the place [m].
        turns: Number of full turns.
        dt: Time between poses [s].
        T_base_sensor: Mounting of the sensor (4, 4).
    """
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
    """Return the trajectory of a legged robot that walks along the straight lines between the corners of a path.

    At a corner it turns on the spot at 1 rad/s. The base follows the height, pitch and roll of the ground under its
    footprint. The gait adds +-1.5 cm of height and +-2 degrees of roll and pitch.

    Args:
        scene: The ground.
        path: x and y of the corners [m].
        speed: Walking speed [m/s].
        dt: Time between poses [s].
        height: Height of the base over the mean ground under its footprint [m].
        sway: Scale of the gait's motion; 0 turns it off.
        below: Boxes whose top lies higher do not count as ground [m]. In a building this selects the floor.
        T_base_sensor: Mounting of the sensor (4, 4).
    """
    xy, yaw = _sample_path(path, speed * dt, dt)
    T = len(yaw)
    times = dt * torch.arange(T, dtype=torch.float64)
    ground, pitch, roll = _fit_ground(scene, xy, yaw, below)
    phase = 2 * math.pi * 1.5 * times  # 1.5 strides a second
    two_degrees = math.radians(2.0)
    z = ground + height + sway * 0.015 * (2 * phase).sin()
    pitch, roll = pitch + sway * two_degrees * (2 * phase + 0.7).sin(), roll + sway * two_degrees * phase.sin()
    T_map_base = pose(torch.cat([xy, z[:, None]], -1), yaw, pitch, roll)
    return Trajectory(T_map_base, T_map_base @ T_base_sensor, times)


def _sample_path(path: Sequence[Point], stride: float, dt: float) -> tuple[Tensor, Tensor]:
    """Return positions (T, 2) [m] and headings (T,) [rad] along the path."""
    corners = torch.tensor(path, dtype=torch.float64)
    legs = corners[1:] - corners[:-1]
    headings = torch.atan2(legs[:, 1], legs[:, 0]).tolist()
    positions, yaws = [corners[:1]], [torch.tensor([headings[0]], dtype=torch.float64)]
    for k, (leg, heading) in enumerate(zip(legs, headings, strict=True)):
        before = float(yaws[-1][-1])
        turn = math.remainder(heading - before, 2 * math.pi)
        count = math.ceil(abs(turn) / dt - 1e-9)
        fraction = torch.arange(1, count + 1, dtype=torch.float64) / max(count, 1)
        positions.append(corners[k].expand(count, 2))
        yaws.append(before + turn * fraction)
        count = max(1, round(float(leg.norm()) / stride))
        fraction = torch.arange(1, count + 1, dtype=torch.float64) / count
        positions.append(corners[k] + fraction[:, None] * leg)
        yaws.append(torch.full((count,), before + turn, dtype=torch.float64))
    return torch.cat(positions), torch.cat(yaws)


def _fit_ground(scene: Scene, xy: Tensor, yaw: Tensor, below: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean height [m], pitch and roll [rad] (T,) of the ground under a footprint of 0.7 x 0.4 m."""
    forward = torch.linspace(-0.35, 0.35, 8, dtype=torch.float64)
    left = torch.linspace(-0.2, 0.2, 4, dtype=torch.float64)
    f, s = (a.reshape(-1) for a in torch.meshgrid(forward, left, indexing="ij"))
    c, d = yaw.cos()[:, None], yaw.sin()[:, None]
    x, y = xy[:, :1] + c * f - d * s, xy[:, 1:] + d * f + c * s
    z = scene.height(x, y, 0.0, below)
    slope_forward, slope_left = z @ f / f.square().sum(), z @ s / s.square().sum()
    return z.mean(-1), -slope_forward.atan(), slope_left.atan()


def sink(poses: Tensor, total: float = 0.15) -> Tensor:
    """Return poses (T, 4, 4) whose height drifts down linearly, until the last one is `total` [m] too low.

    Cast rays from the true poses, and give the map these.
    """
    drifted = poses.clone()
    drifted[:, 2, 3] -= total * torch.linspace(0, 1, len(poses), dtype=poses.dtype)
    return drifted
