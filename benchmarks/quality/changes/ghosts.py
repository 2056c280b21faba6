"""Ghosts: cells that people who crossed the view leave in the map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks.quality.changes.world import GRID, HALF_CELL, PERSON, World
from torchelev.sim import Boxes, MountedSensor

HERTZ = (5, 10, 50)
MARGIN = 0.05  # [m] by which a ray must pass below a cell


@dataclass(frozen=True)
class Crossings:
    """How often and how long people cross each robot's view."""

    number: int = 4
    seconds: float = 5.0  # each
    after: float = 3.0  # [s] from the last one to the count


def crossing(world: World, dt: float, crossings: Crossings) -> Iterator[Boxes]:
    """Yield, scan by scan, a person who crosses in front of each sensor at a random distance, speed and angle."""
    for _ in range(crossings.number):
        near, slant = (torch.rand(2, world.seeds, generator=world.generator) * torch.tensor([[1.8], [1.0]])).unbind(0)
        speed = 1.3 + 0.4 * torch.rand(world.seeds, generator=world.generator)
        side = torch.sign(torch.rand(world.seeds, generator=world.generator) - 0.5)
        for k in range(round(crossings.seconds / dt)):
            along = speed * (k * dt - crossings.seconds / 2)
            yield world.box(1.2 + near + (slant - 0.5) * along, side * along, PERSON)


def ghosts(
    sensor: MountedSensor, hertz: int, seeds: int, compiled: bool, crossings: Crossings | None = None
) -> dict[str, Any]:
    """Count the cells that stay above the ground after the crossings, and the robots that have such cells."""
    world, dt, crossings = World(sensor, seeds, compiled), 1 / hertz, crossings or Crossings()
    return left_behind(world, crossing(world, dt, crossings), dt, round(crossings.after * hertz))


def left_behind(world: World, people: Iterable[Boxes], dt: float, scans_after: int) -> dict[str, Any]:
    """Scan people, and then the ground without them; count what stays above the ground."""
    seeds = world.seeds
    for boxes in people:
        world.scan(boxes, dt)
    gone = world.box(torch.zeros(seeds), torch.zeros(seeds), (0.0, 0.0, 0.0))
    points = torch.full((seeds, 1, 3), math.nan)
    for _ in range(scans_after):
        points = world.scan(gone, dt)
    left = world.above_ground() > 0.1
    count, seen = left.sum((1, 2)), seen_through(world, left, points)
    return {
        "cells": int(count.sum()),
        "environments": int((count > 0).sum()),
        "seen_through": int(seen.sum()),
        "environments_seen_through": int((seen > 0).sum()),
        "of": seeds,
    }


def seen_through(world: World, cells: Tensor, points: Tensor) -> Tensor:
    """Count, for each robot (B,), the cells (B, H, W) that a ray to the points (B, N, 3) passes below by the margin."""
    counts = []
    centers, heights = world.emap.cell_centers(), world.emap.state.elevation
    for marked, center, height, ends, T in zip(
        cells, centers, heights, points, world.T_map_sensor.float(), strict=True
    ):
        ray, place = ends - T[:3, 3], center[marked][:, None] - T[:2, 3]
        reach = ray[:, :2].norm(dim=-1)
        forward = ray[:, :2] / reach[:, None]
        along = (place * forward).sum(-1)
        beside = (place[..., 0] * forward[:, 1] - place[..., 1] * forward[:, 0]).abs() < HALF_CELL
        over = beside & (along > 0) & (along < reach - 2 * GRID.resolution)
        below = T[2, 3] + along * ray[:, 2] / reach < height[marked][:, None] - MARGIN
        counts.append((over & below).any(1).sum())
    return torch.stack(counts)
