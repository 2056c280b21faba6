"""Ground that goes on or ends behind an edge at x = 0 that hides it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.sim import Box, Scene
from torchelev.sim.exact.scenes import block

Disturb = Callable[[Tensor, Tensor, torch.Generator], Tensor]  # of points (N, 3) seen from an origin (3,)
_WIDE = (-9.0, 9.0)  # [m] along y: there is no way around


class Case(NamedTuple):
    """A scene whose edge lies at x = 0 and leaves no way around."""

    kind: str
    scene: Scene  #: the true ground
    goal: float  #: [m] x of the goal beyond the edge
    safe: bool  #: the ground goes on, in steps that the robot takes
    edges: tuple[float, ...] = ()  #: [m] x of the risers and edges behind which a foot may land
    seen: Scene | None = None  #: what the camera sees in place of the ground
    disturb: Disturb | None = None  #: what becomes of the points that it sees


# The ground goes on ---------------------------------------------------------------------------------------------------


def hump(u: list[float]) -> Case:
    """Return a hump of 15 to 25 cm, at most 22 degrees steep, that hides the ground behind it."""
    height = 0.15 + 0.1 * u[0]
    length = math.pi * height / math.tan(math.radians(15 + 7 * u[1]))  # of a raised cosine
    k = 2 * math.pi / length

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(x.abs() < length / 2, height / 2 * (1 + (k * x).cos()), 0.0)

    return Case("hump", Scene(terrain=terrain, steepness=height / 2 * k), length / 2 + 0.6, True)


def brow(u: list[float]) -> Case:
    """Return level ground that falls at 12 to 20 degrees by 0.3 to 0.6 m, and is level again."""
    gradient, fall = math.tan(math.radians(12 + 8 * u[0])), 0.3 + 0.3 * u[1]

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        return -(gradient * x).clamp(0.0, fall)

    return Case("brow", Scene(terrain=terrain, steepness=gradient), fall / gradient + 0.6, True)


def step_down(u: list[float]) -> Case:
    """Return a step down of 5 to 15 cm."""
    return Case("step down", _below(0.05 + 0.1 * u[0]), 1.0, True, edges=(0.0,))


def curb(u: list[float]) -> Case:
    """Return a traffic island of 5 to 15 cm, 0.3 to 1.5 m wide, which hides the road behind it."""
    width = 0.3 + 1.2 * u[1]
    scene = Scene(boxes=(block(0.0, width, *_WIDE, 0.05 + 0.1 * u[0]),))
    return Case("curb", scene, width + 0.6, True, edges=(0.0, width))


def stairs_up(u: list[float]) -> Case:
    """Return six steps up of 8 to 14 cm, 30 to 40 cm deep."""
    return _stairs("stairs up", 0.08 + 0.06 * u[0], 0.3 + 0.1 * u[1])


def stairs_down(u: list[float]) -> Case:
    """Return six steps down of 8 to 14 cm, 30 to 40 cm deep."""
    return _stairs("stairs down", -0.08 - 0.06 * u[0], 0.3 + 0.1 * u[1])


def tall_grass(u: list[float]) -> Case:
    """Return a strip of grass of 20 to 50 cm, 0.8 to 1.6 m wide, on level ground: few rays reach the ground."""
    height, width = 0.2 + 0.3 * u[0], 0.8 + 0.8 * u[1]
    free_path = 0.3  # [m] mean length of a ray in the grass

    def disturb(points: Tensor, origin: Tensor, generator: torch.Generator) -> Tensor:
        """End rays within the grass, as in a medium of even density."""
        ray = points - origin
        enter_x, exit_x = (-origin[0] / ray[:, 0], (width - origin[0]) / ray[:, 0])
        enter_z = (height - origin[2]) / ray[:, 2].clamp(max=-1e-9)  # the camera is above the grass
        enter = torch.maximum(enter_x, enter_z)
        depth = torch.empty_like(enter).exponential_(1 / free_path, generator=generator)
        end = enter + depth / ray.norm(dim=-1)
        stopped = (ray[:, 0] > 0) & (end < exit_x.clamp(max=1.0))
        return torch.where(stopped[:, None], origin + end[:, None] * ray, points)

    return Case("tall grass", Scene(), width + 0.6, True, disturb=disturb)


# The ground ends ------------------------------------------------------------------------------------------------------


def ditch(u: list[float]) -> Case:
    """Return a ditch 0.4 to 0.8 m wide and 0.25 to 0.5 m deep, with sides of the same height."""
    width = 0.4 + 0.4 * u[0]
    return Case("ditch", _below(0.25 + 0.25 * u[1], _beyond(width)), width + 0.8, False)


def trench(u: list[float]) -> Case:
    """Return a trench 0.5 to 1.2 m wide and 0.8 to 2 m deep, with sides of the same height."""
    width = 0.5 + 0.7 * u[0]
    return Case("trench", _below(0.8 + 1.2 * u[1], _beyond(width)), width + 0.8, False)


def cliff(u: list[float]) -> Case:
    """Return a cliff of 0.6 to 2 m; the camera sees the ground at its foot."""
    return Case("cliff", _below(0.6 + 1.4 * u[0]), 1.2, False)


def abyss(u: list[float]) -> Case:
    """Return a cliff of 5 to 10 m, whose foot the camera does not see within the map."""
    return Case("abyss", _below(5.0 + 5.0 * u[0]), 1.2, False)


def glass_wall(u: list[float]) -> Case:
    """Return a wall of glass: rays within 5 to 15 degrees of its normal return, the others see the ground behind."""
    steepest = math.cos(math.radians(5 + 10 * u[0]))

    def disturb(points: Tensor, origin: Tensor, generator: torch.Generator) -> Tensor:
        ray = points - origin
        is_hit = (ray[:, 0] > steepest * ray.norm(dim=-1)) & (points[:, 0] > 0)
        return torch.where(is_hit[:, None], origin - origin[0] / ray[:, :1] * ray, points)

    wall = Scene(boxes=(block(0.0, 0.04, *_WIDE, 2.0),))
    return Case("glass wall", wall, 1.2, False, seen=Scene(), disturb=disturb)


# Parts ----------------------------------------------------------------------------------------------------------------


def _stairs(kind: str, rise: float, run: float, count: int = 6) -> Case:
    """Return steps of `rise` [m], down where it is negative, and level ground before and behind them."""
    nosings = tuple(k * run for k in range(count))
    tops = [(x, x + run, rise * (k + 1)) for k, x in enumerate(nosings[:-1])] + [(nosings[-1], 9.0, rise * count)]
    boxes = tuple(block(low, high, *_WIDE, top) for low, high, top in [(-9.0, 0.0, 0.0), *tops])
    return Case(kind, Scene(terrain=_level(min(-1.0, 2 * rise * count)), boxes=boxes), nosings[-1] + 0.7, True, nosings)


def _below(depth: float, *boxes: Box) -> Scene:
    """Return ground at z = 0 for x < 0 and `depth` [m] lower beyond."""
    return Scene(terrain=_level(-depth), boxes=(block(-9.0, 0.0, *_WIDE, 0.0), *boxes))


def _beyond(width: float) -> Box:
    """Return the far side of a ditch."""
    return block(width, 9.0, *_WIDE, 0.0)


def _level(z: float) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda x, y: torch.full_like(x, z)


KINDS: tuple[Callable[[list[float]], Case], ...] = (
    hump,
    brow,
    step_down,
    curb,
    stairs_up,
    stairs_down,
    tall_grass,
    ditch,
    trench,
    cliff,
    abyss,
    glass_wall,
)
