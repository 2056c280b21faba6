"""The metrics of the visibility clean-up: people who left, static ground, upper bounds."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor

from benchmarks.quality.features.reading import (
    Figures,
    blank_world,
    cells_of,
    fuse,
    percent,
    world_index,
)
from benchmarks.quality.features.recordings import CAMERA, SimulatedRun
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap


def cells_left(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what the map keeps of a person who stood, walked away and left the view.

    The person's cells are those that, after any scan until the person left, were more than 10 cm above the ground and
    within 8 cm of the body's positions so far. `left [%]`: how many of them are more than 10 cm too high in the last
    map, 4 s after the person left; `left after 1 s [%]`: the same after 1 s, which is the map that is returned.
    """
    bodies = [box for box in recording.scene.boxes if not box.grounded]
    gone, body, marked = max(box.until for box in bodies), blank_world(), blank_world()
    left: dict[float, float] = {}  # [%] by the time since the person left [s]
    pictured: list[ElevationMap] = []

    def watch(emap: ElevationMap, k: int) -> None:
        cells, t = cells_of(emap, recording, k), recording.frames[k].t
        at = world_index(cells.xy)
        for box in bodies:
            if box.exists(t):
                low, high = (torch.tensor(corner[:2]) for corner in box.corners(t))
                body[at] |= ((cells.xy >= low - 0.08) & (cells.xy <= high + 0.08)).all(-1)
        high = blank_world()
        high[at] = cells.error > 0.1
        if t < gone:
            marked[:] = marked | (high & body)
        else:
            left[t - gone] = percent(high, marked)
            if t - gone > 0.95 and not pictured:
                pictured.append(copy.deepcopy(emap))

    fuse(recording, cfg, watch)
    soon = min(left, key=lambda since: abs(since - 1.0))
    return {
        "left [%]": left[max(left)],
        "left after 1 s [%]": left[soon],
        "person's cells": float(marked.sum()),
    }, pictured[0]


def wrongly_removed(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what the clean-up removes from a static world.

    A cell is correct if it is within 5 cm of the truth. `removed [%]`: how many of the cells that were ever correct
    turned from correct to unknown at some scan while inside the window, even if they were seen again later.
    `missing at the end [%]`: how many cells of the last window that were correct since they entered it are unknown.
    """
    correct_before, correct_since, ever, removed = (blank_world() for _ in range(4))

    def watch(emap: ElevationMap, k: int) -> None:
        cells = cells_of(emap, recording, k)
        at = world_index(cells.xy)
        correct, unknown = cells.error.abs() <= 0.05, cells.error.isnan()
        removed[at] |= correct_before[at] & unknown
        ever[at] |= correct
        since = correct_since[at] | correct
        for lattice, values in ((correct_before, correct), (correct_since, since)):
            lattice.zero_()[at] = values  # forgets the cells outside the window

    emap = fuse(recording, cfg, watch)
    cells = cells_of(emap, recording)
    return {
        "removed [%]": percent(removed, ever),
        "missing at the end [%]": percent(cells.error.isnan(), correct_since[world_index(cells.xy)]),
        "cells": float(ever.sum()),
    }, emap


def bounds(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure the upper bound of unseen cells.

    A cell is unseen in view if it is unknown in the last map, no exact return ever hit it, and at some scan its center
    was within the camera's horizontal field of view, 0.5 to 4 m away, whether or not a ray passed over it.
    `bounded [%]`: how many of these have a bound. `below truth [%]`: how many of all unknown cells with a bound have
    one more than 1 cm below the truth at their center.
    """
    emap = fuse(recording, cfg)
    cells = cells_of(emap, recording)
    hit = blank_world()
    for points in recording.exact:
        hit[world_index(points[points.isfinite().all(-1), :2])] = True
    unknown = cells.error.isnan()
    unseen = unknown & ~hit[world_index(cells.xy)] & _in_view(recording, cells.xy)
    bound = emap.layer("upper_bound")[0].double()
    bounded = unknown & bound.isfinite()
    below = bound < recording.truth(cells.xy) - 0.01
    return {
        "bounded [%]": percent(bounded, unseen),
        "below truth [%]": percent(below, bounded),
        "unseen cells": float(unseen.sum()),
    }, emap


def _in_view(recording: SimulatedRun, xy: Tensor) -> Tensor:
    """Return which places (H, W, 2) [m] were in the camera's horizontal view, 0.5 to 4 m away, at some scan."""
    seen = torch.zeros(xy.shape[:-1], dtype=torch.bool)
    half = math.radians(CAMERA.fov_x_deg) / 2
    for T in recording.T_true_sensor:
        offset = xy - T[:2, 3]
        heading = torch.atan2(T[1, 0], T[0, 0])
        angle = torch.remainder(torch.atan2(offset[..., 1], offset[..., 0]) - heading + math.pi, 2 * math.pi) - math.pi
        distance = offset.norm(dim=-1)
        seen |= (angle.abs() <= half) & (distance >= 0.5) & (distance <= 4.0)
    return seen
