"""Metrics for the comparison of features. Each fuses a recording with a configuration and returns figures and the map.

Cells are judged against the ground's height at their centres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.quality.feature_recordings import CAMERA, DT, SimulatedRun
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.grid import GridConfig
from torchelev.sim import Box
from torchelev.stages.measure import ExclusionConfig, above_ramp

GRID = GridConfig(resolution=0.04, length_x=10.0, length_y=10.0)
WORLD = 400  # [cells] half the side of the lattice on which cells are remembered while the window moves

Watch = Callable[[ElevationMap, int], None]
Figures = dict[str, float]


def fuse(recording: SimulatedRun, cfg: ElevationMapConfig, watch: Watch | None = None) -> ElevationMap:
    """Map a recording; `watch` sees the map after each frame."""
    emap = ElevationMap(cfg)
    for k, frame in enumerate(recording.frames):
        emap.update(frame.points, frame.T_map_sensor, frame.T_map_base, DT if k else 0.0)
        if watch is not None:
            watch(emap, k)
    return emap


class Cells(NamedTuple):
    """A map as a metric reads it."""

    xy: Tensor  # (H, W, 2) [m]
    elevation: Tensor  # (H, W) [m], NaN where unknown
    error: Tensor  # (H, W) [m], elevation less truth


def cells_of(emap: ElevationMap, recording: SimulatedRun, k: int = -1) -> Cells:
    """Read the map beside the truth at frame k."""
    xy, elevation = emap.cell_centers()[0], emap.layer("elevation")[0].double()
    return Cells(xy, elevation, elevation - recording.truth(xy, k))


def world_index(xy: Tensor) -> tuple[Tensor, Tensor]:
    """Return where cells lie on the lattice that remembers them while the window moves."""
    cell = torch.floor(xy / GRID.resolution).long() + WORLD
    return cell[..., 0], cell[..., 1]


def world() -> Tensor:
    """Return a blank lattice."""
    return torch.zeros(2 * WORLD, 2 * WORLD, dtype=torch.bool)


def share(part: Tensor, whole: Tensor) -> float:
    """Return the share of `whole` that is `part`, NaN if there is none."""
    total = int(whole.sum())
    return float((part & whole).sum()) / total if total else math.nan


def seam_step(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure the step where what the robot sees now meets what it saw long ago, in the last map.

    A seam is a pair of neighbouring cells, one hit within the last 0.5 s, the other last hit 3 s ago or earlier,
    neither cut by a step of the truth (5 cm within 1.5 cells). Its step is the difference of the two cells' errors,
    which a map that shifts as a whole does not change. `seam [cm]` is the median of the absolute step, with range noise
    in it; `seam mean [cm]` the mean of the signed step (new less old), `seam p90 [cm]` the 90th percentile of the
    absolute step.
    """
    emap = fuse(recording, cfg)
    cells, age = cells_of(emap, recording), emap.layer("time")[0]
    level = ~near_step(recording, cells.xy)
    steps = []
    for dim in (0, 1):
        size = age.shape[dim] - 1
        for a, b in ((0, 1), (1, 0)):
            new, old = (lambda layer, s=s, d=dim, n=size: layer.narrow(d, s, n) for s in (a, b))
            pair = (new(age) <= 0.5) & (old(age) >= 3.0) & new(level) & old(level)
            steps.append((new(cells.error) - old(cells.error))[pair])
    step = torch.cat(steps)
    if not len(step):
        return dict.fromkeys(("seam [cm]", "seam mean [cm]", "seam p90 [cm]", "pairs"), math.nan), emap
    return {
        "seam [cm]": 100 * float(step.abs().median()),
        "seam mean [cm]": 100 * float(step.mean()),
        "seam p90 [cm]": 100 * float(step.abs().quantile(0.9)),
        "pairs": float(len(step)),
    }, emap


def near_step(recording: SimulatedRun, xy: Tensor, k: int = -1) -> Tensor:
    """Tell which cells (...), by their centres (..., 2), have a step of 5 cm in the truth within 1.5 cells."""
    reach = GRID.resolution * torch.tensor([-1.5, -0.5, 0.5, 1.5], dtype=torch.float64)
    z = recording.truth(xy[..., None, :] + torch.cartesian_prod(reach, reach), k)
    return z.amax(-1) - z.amin(-1) > 0.05


def cells_left(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what stays of a person who stood, walked away and left the view.

    The person's cells: more than 10 cm above the ground, within 8 cm of where the body was, in the map after any frame
    up to then. `left [%]`: share of them still more than 10 cm too high in the last map, 4 s after the person was gone;
    `left after 1 s [%]`: so after 1 s.
    """
    bodies = [box for box in recording.scene.boxes if not box.grounded]
    gone, where, marked, left = max(box.until for box in bodies), world(), world(), {}

    def watch(emap: ElevationMap, k: int) -> None:
        cells, t = cells_of(emap, recording, k), recording.frames[k].t
        at = world_index(cells.xy)
        for box in bodies:
            if box.exists(t):
                low, high = (torch.tensor(corner[:2]) for corner in box.corners(t))
                where[at] |= ((cells.xy >= low - 0.08) & (cells.xy <= high + 0.08)).all(-1)
        now = world()
        now[at] = cells.error > 0.1
        if t < gone:
            marked[:] = marked | (now & where)
        else:
            left[t - gone] = share(now, marked)

    emap = fuse(recording, cfg, watch)
    soon = min(left, key=lambda since: abs(since - 1.0))
    return {
        "left [%]": 100 * left[max(left)],
        "left after 1 s [%]": 100 * left[soon],
        "person's cells": float(marked.sum()),
    }, emap


def wrongly_removed(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what vanishes of a static world.

    A cell is right if within 5 cm of the truth. `removed [%]`: share of the cells ever right that, at some frame, were
    right before it and unknown after it while still inside the window (even if seen again later).
    `missing at the end [%]`: those unknown in the last map, of the cells that were right since they entered its window.
    """
    right_before, right_since, ever, removed = world(), world(), world(), world()

    def watch(emap: ElevationMap, k: int) -> None:
        cells = cells_of(emap, recording, k)
        at = world_index(cells.xy)
        right, unknown = cells.error.abs() <= 0.05, cells.error.isnan()
        removed[at] |= right_before[at] & unknown
        ever[at] |= right
        since = right_since[at] | right
        for lattice, values in ((right_before, right), (right_since, since)):  # outside the window: forgotten
            lattice.zero_()[at] = values

    emap = fuse(recording, cfg, watch)
    cells = cells_of(emap, recording)
    return {
        "removed [%]": 100 * share(removed, ever),
        "missing at the end [%]": 100 * share(cells.error.isnan(), right_since[world_index(cells.xy)]),
        "cells": float(ever.sum()),
    }, emap


def overhang_cells(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what an overhanging bar and a ceiling leave on the ground.

    Overhang cells: hit by exact returns of bar or ceiling that lay above the default ramp, by none that lay below it.
    `overhang [%]`: share of them more than 10 cm above the ground in the map after any frame.
    `bar at the end [%]`, `ceiling at the end [%]`: of the known cells that it reaches into, those more than 10 cm too
    high in the last map: what the picture shows, whether or not it was below the ramp from somewhere. The bar, 0.35 m
    above the sensor, is below it from more than 1.5 m away; its end at y > 0.65 is never nearer than that.
    `obstacle mapped [%]`: of the cells wholly on the low obstacle's top that an exact return had hit, those within 3 cm
    of it, in the last map before the robot is under the bar or at the end, whichever has fewer.
    """
    within, ever = within_exclusion(recording), world()
    obstacle = next(box for box in recording.scene.boxes if box.grounded)
    bar = recording.scene.boxes[0].low[0]
    mapped, touched = [], world()

    def watch(emap: ElevationMap, k: int) -> None:
        cells = cells_of(emap, recording, k)
        ever[world_index(cells.xy)] |= cells.error > 0.1
        points = recording.exact[k]
        touched[world_index(points[(points[:, 2] - obstacle.high[2]).abs() < 1e-3, :2])] = True
        x = float(recording.T_true_sensor[k, 0, 3])
        if abs(x - (bar - 0.3)) < 0.07 or k == len(recording.frames) - 1:
            low, high = torch.tensor(obstacle.low[:2]) + 0.02, torch.tensor(obstacle.high[:2]) - 0.02
            inside = ((cells.xy > low) & (cells.xy < high)).all(-1) & touched[world_index(cells.xy)]
            mapped.append(100 * share(cells.error.abs() <= 0.03, inside))

    emap = fuse(recording, cfg, watch)
    cells = cells_of(emap, recording)
    high, known = cells.error > 0.1, cells.error.isfinite()
    under = [on_wall(box, cells.xy, GRID.resolution / 2) & known for box in recording.scene.boxes[:2]]
    return {
        "overhang [%]": 100 * share(ever, within),
        "bar at the end [%]": 100 * share(high, under[0]),
        "ceiling at the end [%]": 100 * share(high, under[1]),
        "obstacle mapped [%]": min(mapped),
        "cells": float(within.sum()),
    }, emap


def within_exclusion(recording: SimulatedRun) -> Tensor:
    """Return the lattice's cells whose overhang was only ever seen above the default ramp."""
    above, below = world(), world()
    for k, points in enumerate(recording.exact):
        points = points[points.isfinite().all(-1)]
        overhang = points[:, 2] > recording.truth(points[:, :2], k) + 0.1
        excluded = above_ramp(points - recording.T_true_sensor[k, :3, 3], ExclusionConfig())
        above[world_index(points[overhang & excluded, :2])] = True
        below[world_index(points[overhang & ~excluded, :2])] = True
    return above & ~below


def wall_tops(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure how high walls stand in the map: one of 0.5 m, whose top is seen, and one of 1 m, whose face alone is.

    A row is the cells across a wall that it touches, anywhere along it but for 8 cm at the ends of its pieces, where an
    exact return hit the wall within 2 cm of its top; its height is that of its highest known cell. `wall top [cm]` and
    `tall wall top [cm]`: 90th percentile over rows of the absolute difference from the wall's height, and the share of
    rows that are off by more than 2 cm. `top cells [cm]`: 90th percentile of the absolute error of the cells whose
    centre is on the 0.5 m wall and which an exact return hit on the top; `off by 5 cm [%]`: share of these.
    """
    emap = fuse(recording, cfg)
    cells = cells_of(emap, recording)
    low_wall, tall_wall = recording.scene.boxes[:4], recording.scene.boxes[4:8]
    top = torch.cat([top_errors(recording, cells, piece) for piece in low_wall])
    low = torch.cat([row_errors(recording, cells, piece) for piece in low_wall])
    tall = torch.cat([row_errors(recording, cells, piece) for piece in tall_wall])
    return {
        "wall top [cm]": 100 * float(low.quantile(0.9)),
        "wall rows off by 2 cm [%]": 100 * float((low > 0.02).double().mean()),
        "tall wall top [cm]": 100 * float(tall.quantile(0.9)),
        "tall wall rows off by 2 cm [%]": 100 * float((tall > 0.02).double().mean()),
        "tall wall rows": float(len(tall)),
        "top cells [cm]": 100 * float(top.quantile(0.9)),
        "off by 5 cm [%]": 100 * float((top > 0.05).double().mean()),
        "top cells": float(len(top)),
    }, emap


def on_wall(wall: Box, xy: Tensor, margin: float) -> Tensor:
    """Tell which places (..., 2) lie on a wall, or within `margin` [m] of it."""
    low, high = torch.tensor(wall.low[:2]) - margin, torch.tensor(wall.high[:2]) + margin
    return ((xy >= low) & (xy <= high)).all(-1)


def top_errors(recording: SimulatedRun, cells: Cells, wall: Box) -> Tensor:
    """Return the absolute errors of the known cells with their centre on the wall and an exact return on their top."""
    hit = hits(recording, wall, wall.high[2] - 1e-3)[world_index(cells.xy)]
    return cells.error[on_wall(wall, cells.xy, 0.0) & hit & cells.error.isfinite()].abs()


def row_errors(recording: SimulatedRun, cells: Cells, wall: Box) -> Tensor:
    """Return, for each row of cells across the wall, the absolute difference of its height from the wall's."""
    y = cells.xy[..., 1]
    along = (y > wall.low[1] + 0.08) & (y < wall.high[1] - 0.08)
    on = on_wall(wall, cells.xy, GRID.resolution / 2) & along
    seen = (on & hits(recording, wall, wall.high[2] - 0.02)[world_index(cells.xy)]).any(0)
    height = cells.elevation.nan_to_num(nan=-math.inf).masked_fill(~on, -math.inf).amax(0)
    return (height.clamp(min=0.0) - wall.high[2]).abs()[seen]


def hits(recording: SimulatedRun, wall: Box, above: float) -> Tensor:
    """Return the lattice's cells in which an exact return hit the wall higher than `above` [m]."""
    hit = world()
    for points in recording.exact:
        # A face's return lies on the border; a hair farther in or out is the wall's too.
        hit[world_index(points[on_wall(wall, points[:, :2], 1e-5) & (points[:, 2] > above), :2])] = True
    return hit


def other_floor(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what stays of the floor that the robot left.

    `other floor [%]`: of the known cells within 3 m of the robot, those whose error is more than half a storey
    (1.36 m), cells at a step of the truth left out, in the last map. `worst [%]`: the largest such share in any map
    from 5 s after the robot is on the new floor.
    """
    last, worst = recording.frames[-1].T_map_base[0, 2, 3], [0.0]

    def near_and_wrong(emap: ElevationMap, k: int) -> float:
        cells = cells_of(emap, recording, k)
        away = (cells.xy - recording.frames[k].T_map_base[0, :2, 3]).norm(dim=-1)
        judged, wrong = (away <= 3.0) & cells.error.isfinite(), cells.error.abs() > 1.36
        at_edge = wrong.clone()
        at_edge[wrong] = near_step(recording, cells.xy[wrong], k)
        return 100 * share(wrong, judged & ~at_edge)

    heights = torch.stack([frame.T_map_base[0, 2, 3] for frame in recording.frames])
    arrived = int(torch.nonzero((heights - last).abs() > 0.2).max()) + 1

    def watch(emap: ElevationMap, k: int) -> None:
        if k >= arrived + round(5 / DT):
            worst.append(near_and_wrong(emap, k))

    emap = fuse(recording, cfg, watch)
    return {"other floor [%]": near_and_wrong(emap, -1), "worst [%]": max(worst)}, emap


def bounds(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure the upper bound of unseen cells.

    Unseen in view: unknown in the last map, no exact return ever hit it, and its centre was within the camera's
    horizontal field of view, 0.5 to 4 m from it, at some frame, whether or not a ray passed over. `bounded [%]`: those
    with a bound. `below truth [%]`: of all unknown cells with a bound, those whose bound is more than 1 cm below the
    truth at the centre.
    """
    emap = fuse(recording, cfg)
    cells = cells_of(emap, recording)
    touched = world()
    for points in recording.exact:
        touched[world_index(points[points.isfinite().all(-1), :2])] = True
    unknown = cells.error.isnan()
    unseen = unknown & ~touched[world_index(cells.xy)] & in_view(recording, cells.xy)
    bound = emap.layer("upper_bound")[0].double()
    bounded = unknown & bound.isfinite()
    below = bound < recording.truth(cells.xy) - 0.01
    return {
        "bounded [%]": 100 * share(bounded, unseen),
        "below truth [%]": 100 * share(below, bounded) if bool(bounded.any()) else math.nan,
        "unseen cells": float(unseen.sum()),
    }, emap


def in_view(recording: SimulatedRun, xy: Tensor) -> Tensor:
    """Tell which places (H, W, 2) were within the camera's horizontal field of view, 0.5 to 4 m away, at some frame."""
    seen = torch.zeros(xy.shape[:-1], dtype=torch.bool)
    half = math.radians(CAMERA.fov_x_deg) / 2
    for T in recording.T_true_sensor:
        away = xy - T[:2, 3]
        heading = torch.atan2(T[1, 0], T[0, 0])
        angle = torch.remainder(torch.atan2(away[..., 1], away[..., 0]) - heading + math.pi, 2 * math.pi) - math.pi
        distance = away.norm(dim=-1)
        seen |= (angle.abs() <= half) & (distance >= 0.5) & (distance <= 4.0)
    return seen
