"""The simulated scans: closed-form scenes, seen on three motions, with three kinds of noise."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev import GridConfig
from torchelev.sim import mount
from torchelev.sim.exact import noise, scenes, sensors, trajectories
from torchelev.sim.exact.scenes import Scene

GRID = GridConfig(resolution=0.04, length_x=8.0, length_y=8.0)
SCENES: dict[str, Callable[[], Scene]] = {
    "flat": scenes.flat,
    "slope 15°": scenes.slope,
    "rough": scenes.rough,
    "stairs": scenes.stairs,
    "boxes": scenes.boxes,
    "mixed": scenes.mixed,
}
NOISES: dict[str, Callable[[Tensor, torch.Generator], Tensor]] = {
    "none": lambda points, generator: points,
    "noisy": noise.noisy,
    "outliers": lambda points, generator: noise.outliers(
        noise.noisy(points, generator), generator, dust=0.03, flying=0.03, too_long=0.02
    ),
}


class SimulatedRun(NamedTuple):
    """The noiseless scans of a scene along a path."""

    scene: Scene
    clean: list[Tensor]  #: T scans (M, 3) [m], sensor frame
    T_map_sensor: Tensor  #: (T, 4, 4)
    T_map_base: Tensor  #: (T, 4, 4)


@functools.cache
def record(name: str, motion: str) -> SimulatedRun:
    """Simulate the scans of a scene on a motion, once."""
    scene = SCENES[name]()
    sensor: sensors.DepthCamera | sensors.Lidar = sensors.DepthCamera()
    if motion == "turn":
        path = trajectories.turn_on_the_spot(0.8, 36, scene=scene)
    elif motion == "walk":
        path = trajectories.walk(scene, [(-1.5, 0.0), (0.5, 0.0), (0.5, 0.6)])
    else:
        sensor = sensors.Lidar()
        level = mount(pitch_deg=0.0)
        path = trajectories.walk(scene, [(-1.0, 0.0), (0.2, 0.0)], speed=0.6, T_base_sensor=level)
    clean = [sensor.cast(scene, T, float(t)) for T, t in zip(path.T_map_sensor, path.times, strict=True)]
    return SimulatedRun(scene, clean, path.T_map_sensor, path.T_map_base)


def corrupt(recording: SimulatedRun, kind: str) -> list[Tensor]:
    """Return a recording's scans with noise, the same in every run."""
    generator = torch.Generator().manual_seed(1)
    return [NOISES[kind](points, generator) for points in recording.clean]
