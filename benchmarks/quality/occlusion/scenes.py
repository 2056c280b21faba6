"""Ground that continues or drops, unseen, behind an edge at x = 0, and the maps of a robot that walks up to it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim import Box, DepthCamera, Scene, mount, noisy, walk
from torchelev.sim.exact.scenes import block

GRID = GridConfig(resolution=0.04, length_x=12.0, length_y=4.0)
CAMERA, T_BASE_CAMERA = DepthCamera(max_range=8.0), mount(pitch_deg=30.0)
DT, SPEED = 0.2, 0.5  # [s], [m/s]
FROM, TO = -2.8, -0.6  # [m] of the walk along x
VIEWS = (2.4, 2.0, 1.6, 1.2, 0.8)  # [m] distances from the edge at which the map is used


class Case(NamedTuple):
    """A scene whose edge lies at x = 0 and leaves no way around."""

    kind: str
    scene: Scene
    goal: float  #: [m] x of the goal beyond the edge
    safe: bool  #: the ground continues


def hump(u: list[float]) -> Case:
    """Return a hump of 15 to 25 cm, at most 22 degrees steep, that hides the ground behind it."""
    height = 0.15 + 0.1 * u[0]
    length = math.pi * height / math.tan(math.radians(15 + 7 * u[1]))  # of a raised cosine
    k = 2 * math.pi / length

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(x.abs() < length / 2, height / 2 * (1 + (k * x).cos()), 0.0)

    return Case("hump", Scene(terrain=terrain, steepness=height / 2 * k), length / 2 + 0.6, True)


def brow(u: list[float]) -> Case:
    """Return level ground that falls at 12 to 20 degrees by 0.4 to 0.8 m, and is level again."""
    gradient, fall = math.tan(math.radians(12 + 8 * u[0])), 0.4 + 0.4 * u[1]

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        return -(gradient * x).clamp(0.0, fall)

    return Case("brow", Scene(terrain=terrain, steepness=gradient), fall / gradient + 0.6, True)


def step_down(u: list[float]) -> Case:
    """Return a step down of 5 to 10 cm."""
    return Case("step down", _below(0.05 + 0.05 * u[0]), 1.0, True)


def trench(u: list[float]) -> Case:
    """Return a trench 0.5 to 1.2 m wide and 0.8 to 2 m deep, with sides of the same height."""
    width = 0.5 + 0.7 * u[0]
    beyond = block(width, 9.0, -9.0, 9.0, 0.0)
    return Case("trench", _below(0.8 + 1.2 * u[1], beyond), width + 0.8, False)


def cliff(u: list[float]) -> Case:
    """Return a cliff of 0.6 to 2 m; the camera sees the ground at its foot."""
    return Case("cliff", _below(0.6 + 1.4 * u[0]), 1.2, False)


def abyss(u: list[float]) -> Case:
    """Return a cliff of 5 to 10 m, whose foot the camera does not see within the map."""
    return Case("abyss", _below(5.0 + 5.0 * u[0]), 1.2, False)


def _below(depth: float, *boxes: Box) -> Scene:
    """Return ground at z = 0 for x < 0 and `depth` [m] lower beyond."""

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        return torch.full_like(x, -depth)

    return Scene(terrain=terrain, boxes=(block(-9.0, 0.0, -9.0, 9.0, 0.0), *boxes))


KINDS: tuple[Callable[[list[float]], Case], ...] = (hump, brow, step_down, trench, cliff, abyss)


def views(case: Case, generator: torch.Generator) -> dict[float, tuple[ElevationMap, float]]:
    """Walk up to the edge; return a copy of the map and the robot's x [m] at each of VIEWS."""
    emap, shots = ElevationMap(ElevationMapConfig(grid=GRID)), {}
    path = walk(case.scene, [(FROM, 0.0), (TO, 0.0)], speed=SPEED, dt=DT, T_base_sensor=T_BASE_CAMERA)
    for T_base, T_sensor, t in zip(*path, strict=True):
        points = noisy(CAMERA.cast(case.scene, T_sensor, float(t)), generator)
        emap.update(points[None], T_sensor[None], T_base[None], DT)
        x = float(T_base[0, 3])
        view = next((v for v in VIEWS if abs(x + v) < SPEED * DT / 2), None)
        if view is not None:
            shots[view] = (_copy(emap), x)
    return shots


def _copy(emap: ElevationMap) -> ElevationMap:
    copy = ElevationMap(emap.cfg)
    copy.load_state_dict(emap.state_dict())
    return copy
