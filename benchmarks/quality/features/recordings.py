"""The recordings: simulated walks with known ground truth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.sim import Box, DepthCamera, Lidar, Scene, Trajectory, dropout, mount, outliers, range_noise, sink, walk
from torchelev.sim.exact import scenes
from torchelev.sim.waves import natural_waves

DT = 0.2  # [s]
CAMERA = DepthCamera(max_range=6.0)
_DOME = Lidar(rings=48, azimuths=720, fov_low_deg=-60.0, fov_high_deg=60.0, max_range=10.0)


class SimulatedScan(NamedTuple):
    """One scan, with the poses as the robot estimates them."""

    points: Tensor  #: (1, N, 3) [m] sensor frame
    T_map_sensor: Tensor  #: (1, 4, 4)
    T_map_base: Tensor  #: (1, 4, 4)
    t: float  #: [s]
    below: float  #: [m] height below which the ground is: what is above belongs to another floor


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatedRun:
    """A scene and T scans of it."""

    scene: Scene
    frames: list[SimulatedScan]
    exact: list[Tensor]  #: the noiseless points (N, 3) [m] of each scan in the true map frame
    T_true_sensor: Tensor  #: (T, 4, 4)

    def truth(self, xy: Tensor, k: int = -1) -> Tensor:
        """Return the height of the ground (...) [m] at places (..., 2) [m] at scan k."""
        return self.scene.truth(xy, self.frames[k].t, self.frames[k].below)


def _record(
    scene: Scene,
    path: Trajectory,
    *,
    sensor: DepthCamera | Lidar = CAMERA,
    believed: Trajectory | None = None,
    below: Sequence[float] | None = None,
    too_long: float = 0.0,
    seed: int = 0,
) -> SimulatedRun:
    """Simulate the scans along a path, with noise.

    Args:
        scene: the world.
        path: the true path.
        sensor: casts the rays.
        believed: the path as the robot estimates it; None: the true one.
        below: height below which the ground is at each scan [m]; None: no limit.
        too_long: fraction of the returns that are too long.
        seed: of the noise.
    """
    generator = torch.Generator().manual_seed(seed)
    believed = believed or path
    frames, exact = [], []
    noise = {"constant": 0.01, "quadratic": 0.0} if isinstance(sensor, Lidar) else {}
    for k, t in enumerate(path.times.tolist()):
        clean = sensor.cast(scene, path.T_map_sensor[k], t)
        points = outliers(range_noise(clean, generator, **noise), generator, too_long=too_long)
        points = dropout(points, generator, share=0.02)
        T = path.T_map_sensor[k]
        exact.append(clean.double() @ T[:3, :3].T + T[:3, 3])
        level = math.inf if below is None else below[k]
        frames.append(
            SimulatedScan(points[None], believed.T_map_sensor[k][None], believed.T_map_base[k][None], t, level)
        )
    return SimulatedRun(scene=scene, frames=frames, exact=exact, T_true_sensor=path.T_map_sensor)


def _lane(seed: int = 3) -> Scene:
    """Return rough ground (about +-5 cm) with boxes of 10 to 50 cm on both sides of a lane along y = 0."""
    relief = natural_waves(seed, amplitude=0.05)
    left = scenes.crates(seed, 10, (-3.5, 3.5, 0.9, 3.0))
    right = scenes.crates(seed + 1, 10, (-3.5, 3.5, -3.0, -0.9))
    return Scene(name="lane", terrain=relief, steepness=relief.steepness, boxes=(*left, *right))


def record_drift() -> SimulatedRun:
    """Record a walk around a square on rough ground with boxes, while the odometry sinks steadily by 15 cm."""
    relief = natural_waves(5, amplitude=0.05)
    inner, outer = scenes.crates(5, 4, (-0.6, 0.6, -0.4, 0.4)), scenes.crates(6, 14, (-4.0, 4.0, 2.2, 4.0))
    scene = Scene(name="square", terrain=relief, steepness=relief.steepness, boxes=(*inner, *outer))
    square = [(-1.5, -1.3), (1.5, -1.3), (1.5, 1.3), (-1.5, 1.3), (-1.5, -1.3), (0.0, -1.3)]
    path = walk(scene, square, dt=DT)
    drifted = path._replace(T_map_base=sink(path.T_map_base), T_map_sensor=sink(path.T_map_sensor))
    return _record(scene, path, believed=drifted)


def record_person(too_long: float = 0.0) -> SimulatedRun:
    """Record a person 3 m ahead on the lane, who walks away along it from t = 2 s and is gone at t = 6 s."""
    scene, pace = _lane(), 1.0
    stands = scenes.person(until=2.0, x=0.713, y=-0.2).boxes[0]
    behind = stands.low[0] - 2.0 * pace, stands.high[0] - 2.0 * pace  # extrapolated to t = 0
    walks = Box(
        low=(behind[0], -0.2, 0.0), high=(behind[1], 0.3, 1.7), velocity=(pace, 0.05, 0.0), since=2.0, until=6.0
    )
    scene = dataclasses.replace(scene, boxes=(*scene.boxes, stands, walks))
    return _record(scene, walk(scene, [(-2.0, 0.0), (0.5, 0.0)], speed=0.25, dt=DT), too_long=too_long)


def record_static(too_long: float = 0.0) -> SimulatedRun:
    """Record a walk over rough ground, up two steps of a stair and down again, in a static scene with boxes."""
    scene = scenes.mixed(0)  # the walk goes no higher: from the landing, the ground would be another floor
    path = walk(scene, [(-2.6, 0.05), (1.75, 0.05), (1.75, -0.35), (0.4, -0.9)], speed=0.6, dt=DT)
    return _record(scene, path, too_long=too_long)


def record_overhang() -> SimulatedRun:
    """Record a walk under a bar and a ceiling, past an obstacle, with a lidar that sees from -60 to 60 degrees."""
    scene = scenes.overhang()
    path = walk(scene, [(-1.5, -0.85), (4.0, -0.85)], dt=DT, T_base_sensor=mount(0.0))
    return _record(scene, path, sensor=_DOME)


def _staggered_wall(x: float, y0: float, y1: float, top: float) -> list[Box]:
    """Return a wall, 21 cm thick, of four pieces, each set back by 1 cm so that the faces cut the cells differently."""
    length = (y1 - y0) / 4
    return [
        scenes.block(x + 0.01 * k, x + 0.01 * k + 0.21, y0 + k * length, y0 + (k + 1) * length, top) for k in range(4)
    ]


def record_walls() -> SimulatedRun:
    """Record a walk towards walls of 0.5 m and 1 m, with a camera pitched down by only 15 degrees."""
    pieces = (*_staggered_wall(1.987, -2.5, -0.313, 0.5), *_staggered_wall(2.493, 0.307, 2.9, 1.0))
    scene = Scene(name="walls", boxes=(*pieces, scenes.block(1.213, 1.437, -0.191, 0.227, 0.12)))
    route = [(-1.0, -0.6), (0.7, -0.6), (0.7, 0.9), (1.6, 1.2)]
    return _record(scene, walk(scene, route, dt=DT, T_base_sensor=mount(15.0)))


def record_floors(up: bool) -> SimulatedRun:
    """Record a walk on one floor, over the stairs, and on the other floor above or below the first path."""
    scene = scenes.two_floors()
    route = [(3.0, -1.0), (-3.2, -1.0), (-3.2, 1.6), (3.2, 1.6), (3.2, -1.0), (-1.0, -1.0)]
    if up:
        lower, upper = walk(scene, route[:3], speed=0.8, dt=DT, below=1.0), walk(scene, route[2:], speed=0.8, dt=DT)
        path, count = lower.then(upper), len(lower.times)
        below = [1.0] * count + [math.inf] * len(upper.times)
    else:
        upper = walk(scene, route[:1:-1], speed=0.8, dt=DT)
        lower = walk(scene, route[2::-1], speed=0.8, dt=DT, below=1.0)
        path, count = upper.then(lower), len(upper.times)
        below = [math.inf] * count + [1.0] * len(lower.times)
    return _record(scene, path, below=below)


def record_hidden(too_long: float = 0.0) -> SimulatedRun:
    """Record a walk down the lane; the ground behind the boxes stays unseen."""
    scene = _lane()
    return _record(scene, walk(scene, [(-2.0, 0.0), (1.5, 0.0)], dt=DT), too_long=too_long)
