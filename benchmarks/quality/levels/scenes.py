"""Walks through covered scenes, and what is true on the way: which surface is the ground, and which space is free.

A surface is the top of a box or the terrain, where nothing is within `FREE_HEIGHT` above it. The ground of a cell is
the surface on which the shortest way by steps of at most `MAX_STEP` from the robot's feet first enters it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.sim.exact import covered_scenes
from torchelev.sim.exact.scenes import Scene
from torchelev.sim.exact.sensors import Lidar
from torchelev.sim.exact.trajectories import _sample_path
from torchelev.sim.poses import pose

LIDAR = Lidar(rings=64, azimuths=512, fov_low_deg=-60, fov_high_deg=60, max_range=12.0)
MOUNT = (0.2, 0.0, 0.1)  # [m] lidar on the base
BASE_HEIGHT = 0.45  # [m] over the feet
STRIDE, TURN = 0.06, 0.1  # [m], [rad] between two scans
FREE_HEIGHT, MAX_STEP = 0.4, 0.3  # [m]
VOXEL = 0.05  # [m], the cells' size too
ORIGIN = torch.tensor([250, 250, 40])  # index of the voxel whose lowest corner is at 0
SHAPE = (500, 500, 160)  # voxels
WINDOW = 160  # cells along a side of the maps
NEAR = 6.0  # [m] beyond which rays leave every window
MIN_HITS = 3  # points that make a surface count
SAMPLE = 20_000  # voxels of each kind and scan that are compared
NONE = -1


@dataclass(frozen=True)
class Walk:
    """A walk through a scene, along the straight lines between the corners of a path."""

    scene: Callable[[], Scene]
    path: Sequence[tuple[float, float]]  #: [m] x and y


WALKS = {
    "table": Walk(covered_scenes.table, [(-2, 0), (3.6, 0), (3.6, 1.2), (0, 1.2)]),
    "over the bridge": Walk(covered_scenes.bridge, [(-7, 0), (7, 0)]),
    "under the bridge": Walk(covered_scenes.bridge, [(0, -5), (0, 4)]),
    "stairwell": Walk(
        covered_scenes.stairwell, [(-1.5, 0.6), (2.9, 0.6), (2.9, -0.6), (-0.6, -0.6), (-0.6, 0.6), (2.9, 0.6)]
    ),
    "door": Walk(covered_scenes.door, [(-2, 0), (4, 0)]),
    "culvert": Walk(covered_scenes.culvert, [(-1, 0), (7.5, 0)]),
    "branches": Walk(covered_scenes.branches, [(-1, 0), (4, 0)]),
}


class Truth(NamedTuple):
    """What is true in the window of a map, of H x W cells."""

    first: Tensor  #: (3,) number of the first cell, and 0
    foot: float  #: [m] height of what the robot stands on
    cell: tuple[int, int]  #: where it stands
    ground: Tensor  #: (H, W) [m], NaN where no way leads to any of several surfaces
    tops: Tensor  #: (K, H, W) [m] all surfaces, inf for none
    ceiling: Tensor  #: (H, W) [m] over the middle of the cell, inf for none
    lowest: Tensor  #: (H, W) [m] ceiling over any of the cell, inf for none
    counts: Tensor  #: (H, W) the ground was hit from above, and is that of the cells around to 2 cm
    ceiling_hit: Tensor  #: (H, W) the lowest ceiling was hit from below
    ceiling_even: Tensor  #: (H, W) the ceiling is that of the places up to a cell around to 2 cm
    free: Tensor  #: (N, 3) numbers of voxels that rays passed, at least a voxel from anything
    occupied: Tensor  #: (N, 3) numbers of voxels that rays hit


class Scan(NamedTuple):
    """A scan without noise, and what is true then."""

    number: int
    points: Tensor  #: (M, 3) [m] sensor frame, NaN without a return
    T_sensor: Tensor  #: (4, 4)
    T_base: Tensor  #: (4, 4)
    truth: Callable[[Tensor], Truth] | None  #: of the window with these cell centers (H, W, 2) [m]


def surfaces(scene: Scene, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Return the tops [m] of terrain and boxes at xy (..., 2) [m], and where they are surfaces, both (K, ...)."""
    x, y = xy.unbind(-1)
    tops = [scene.terrain(x, y)] + [torch.full_like(x, box.high[2]) for box in scene.boxes]
    there = [torch.ones_like(x, dtype=torch.bool)] + [box.covers(x, y) for box in scene.boxes]
    top, is_surface = torch.stack(tops), torch.stack(there)
    for box in scene.boxes:
        in_or_close_below = (top >= box.low[2] - FREE_HEIGHT + 1e-9) & (top < box.high[2] - 1e-9)
        is_surface &= ~(box.covers(x, y) & in_or_close_below)
    return top, is_surface


def reach(heights: Tensor, foot: float, cell: tuple[int, int], blind: int = 0) -> Tensor:
    """Return the number of the surface on which a robot first enters each cell (H, W); NONE where it enters none.

    Args:
        heights: of surfaces (K, H, W) [m], in ascending order, then inf.
        foot: height of what it stands on [m].
        cell: where it stands. It begins in the cell nearest to it that has a surface within a step from `foot`.
        blind: cells without surfaces over which the ground is taken to go on.
    """
    K, H, W = heights.shape
    step = (heights - foot).abs()
    i, j = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    away = torch.where(step.amin(0) <= MAX_STEP, (i - cell[0]).square() + (j - cell[1]).square(), 10**9)
    start = int(away.argmin())
    height, first = heights.flatten(1).T.tolist(), [NONE] * (H * W)
    seen = [0] * (H * W)
    queue = deque([(start, height[start][k], 0) for k in [int(step.flatten(1)[:, start].argmin())]])
    while queue:
        at, z, count = queue.popleft()
        row, column = divmod(at, W)
        for to, inside in ((at - W, row > 0), (at + W, row < H - 1), (at - 1, column > 0), (at + 1, column < W - 1)):
            if not inside:
                continue
            for k, h in enumerate(height[to]):
                if abs(h - z) <= MAX_STEP and not seen[to] >> k & 1:
                    seen[to] |= 1 << k
                    queue.append((to, h, 0))
                    first[to] = k if first[to] == NONE else first[to]
            if count < blind and height[to][0] == torch.inf and not seen[to]:
                seen[to] = 1 << K
                queue.append((to, z, count + 1))
    return torch.tensor(first).view(H, W)


def choose(heights: Tensor, foot: float, cell: tuple[int, int], blind: int = 0) -> tuple[Tensor, Tensor]:
    """Return number and height [m] of each cell's ground (H, W), NaN for none; a lone surface needs no way to it."""
    first = reach(heights, foot, cell, blind)
    is_lone = (first == NONE) & (heights[0] < torch.inf) & ((heights < torch.inf).sum(0) == 1)
    number = torch.where(is_lone, 0, first)
    height = heights.gather(0, number.clamp(min=0)[None])[0]
    return number, torch.where(number == NONE, torch.nan, height)


def record(walk: Walk, stride: int, scored: int) -> Iterator[Scan]:
    """Yield every `stride`-th scan of a walk; the truth comes with every `scored`-th."""
    scene = walk.scene()
    xy, yaw, foot, z = _feet(scene, walk.path)
    space = _Space(scene)
    for k in range(0, len(xy), stride):
        T_base = pose(torch.tensor([*xy[k].tolist(), float(z[k]) + BASE_HEIGHT], dtype=torch.float64), yaw[k])
        T_sensor = T_base.clone()
        T_sensor[:3, 3] += T_base[:3, :3] @ torch.tensor(MOUNT, dtype=torch.float64)
        points = LIDAR.cast(scene, T_sensor)
        is_scored = k > 0 and k % scored == 0
        space.enter(xy[k])
        space.add(to_map(points, T_sensor), T_sensor[:3, 3], is_scored)
        yield Scan(
            k, points, T_sensor, T_base, partial(space.truth, foot=float(foot[k]), xy=xy[k]) if is_scored else None
        )


def to_map(points: Tensor, T_sensor: Tensor) -> Tensor:
    """Return the returns (N, 3) [m] among points of the sensor frame, in the map frame."""
    placed = points.double() @ T_sensor[:3, :3].T + T_sensor[:3, 3]
    return placed[placed.isfinite().all(-1)]


def voxels_of(points: Tensor) -> Tensor:
    """Return the numbers (N, 3) of the voxels that hold points (N, 3) [m], of those within `SHAPE`."""
    found = (points / VOXEL).floor().long()
    return found[((found >= -ORIGIN) & (found < torch.tensor(SHAPE) - ORIGIN)).all(-1)]


def places(voxels: Tensor) -> tuple[Tensor, ...]:
    """Return voxels as an index of a tensor of shape `SHAPE`."""
    return (voxels + ORIGIN).unbind(-1)


def _feet(scene: Scene, path: Sequence[tuple[float, float]]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return positions, headings, heights of the feet [m], and these smoothed for the base."""
    xy, yaw = _sample_path(path, STRIDE, TURN)
    heights, z = [], 0.0
    for place in xy:
        top, is_surface = surfaces(scene, place)
        z = float(top[is_surface & (top <= z + MAX_STEP)].max())
        heights.append(z)
    foot = torch.tensor(heights, dtype=torch.float64)
    smooth = F.avg_pool1d(F.pad(foot[None, None], (3, 3), mode="replicate"), 7, 1)[0, 0]
    return xy, yaw, foot, smooth


class _Space:
    """What rays hit and passed so far, in voxels."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.hits = torch.zeros(2, *SHAPE, dtype=torch.int32)  # by rays that go down, and up
        self.passed = torch.zeros(SHAPE, dtype=torch.bool)
        self.is_clear = _clear(scene)
        self.corner: list[int] = []
        self.generator = torch.Generator().manual_seed(0)

    def enter(self, xy: Tensor) -> None:
        """Forget hits in cells that enter the window around a place [m], as the map does not know them any more."""
        corner = ((xy / VOXEL).round().long() + ORIGIN[:2] - WINDOW // 2).tolist()
        for axis, (old, new) in enumerate(zip(self.corner or corner, corner, strict=True), 1):
            first = old + WINDOW if new > old else new
            self.hits.narrow(axis, first, min(abs(new - old), WINDOW)).zero_()
        self.corner = corner

    def add(self, points: Tensor, origin: Tensor, passes: bool) -> None:
        """Take in the returns (N, 3) [m] of a scan, and what its rays passed."""
        is_up = points[:, 2] > origin[2]
        for hits, chosen in zip(self.hits, (points[~is_up], points[is_up]), strict=True):
            hit = places(voxels_of(chosen))
            hits.index_put_(hit, torch.ones(len(hit[0]), dtype=torch.int32), accumulate=True)
        if passes:  # those of the scans that are scored are many enough
            ray = points - origin
            reach = ray.norm(dim=-1)
            for d in torch.arange(0.1, NEAR, VOXEL).tolist():
                far = reach > d + VOXEL
                self.passed[places(voxels_of(origin + ray[far] * (d / reach[far])[:, None]))] = True

    def truth(self, centers: Tensor, foot: float, xy: Tensor) -> Truth:
        """Return what is true in the window with these cell centers."""
        corner = (centers[0, 0] / VOXEL).floor().long()
        i, j = ((xy / VOXEL).floor().long() - corner).tolist()
        top, is_surface = surfaces(self.scene, centers)
        tops = torch.where(is_surface, top, torch.inf).sort(0).values
        ground = choose(tops[:4], foot, (i, j))[1]
        ceiling = self.scene.ceiling(centers, ground)
        lowest, even = self._ceilings_around(centers, ground)
        counts = ground.isfinite() & _is_even(ground) & self._was_hit(0, centers, ground)
        hit = lowest.isfinite() & self._was_hit(1, centers, lowest)
        window = tuple(slice(int(c + o), int(c + o) + n) for c, o, n in zip(corner, ORIGIN, ground.shape, strict=False))
        free, occupied = (
            self.passed[window] & self.is_clear[window],
            self.hits[(slice(None), *window)].sum(0) >= MIN_HITS,
        )
        first = torch.tensor([*corner.tolist(), -int(ORIGIN[2])])
        some = (self._some(mask) + first for mask in (free, occupied))
        place = F.pad(corner, (0, 1)), foot, (i, j)
        return Truth(*place, ground, tops, ceiling, lowest, counts, hit, even, *some)

    def _ceilings_around(self, centers: Tensor, ground: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lowest ceiling over each cell, and whether all up to a cell around agree; thin boxes count."""
        halves = range(-2, 3)
        found = {
            (i, j): self.scene.ceiling(centers + 0.499 * VOXEL * torch.tensor([i, j]), ground).clamp(max=99.0)
            for i in halves
            for j in halves
        }
        lowest = torch.stack([z for (i, j), z in found.items() if max(abs(i), abs(j)) < 2]).amin(0)
        around = torch.stack([*found.values()])
        even = around.amax(0) - around.amin(0) < 0.02
        return torch.where(lowest < 99.0, lowest, torch.inf), even

    def _was_hit(self, side: int, centers: Tensor, height: Tensor) -> Tensor:
        """Return where rays that go down (0) or up (1) ended within a voxel of a height (H, W) [m]."""
        z = torch.where(height.isfinite(), height, 0.0)[..., None]
        upper = (torch.cat([centers, z + 0.5 * VOXEL], -1) / VOXEL).floor().long()
        x, y, k = places(upper)
        return self.hits[side, x, y, k - 1] + self.hits[side, x, y, k] >= MIN_HITS

    def _some(self, mask: Tensor) -> Tensor:
        """Return the indices (N, 3) of at most `SAMPLE` places of a mask."""
        found = mask.nonzero()
        return found[torch.randperm(len(found), generator=self.generator)[:SAMPLE]]


def _clear(scene: Scene) -> Tensor:
    """Return which voxels are at least a voxel from boxes and terrain."""
    x, y, z = (VOXEL * (torch.arange(n, dtype=torch.float64) - o) for n, o in zip(SHAPE, ORIGIN, strict=True))
    terrain = scene.terrain(*torch.meshgrid(x, y, indexing="ij"))
    clear = z - VOXEL >= terrain[..., None] - 1e-9
    for box in scene.boxes:
        ends = zip((x, y, z), box.low, box.high, strict=True)
        near = [(c + 2 * VOXEL > low) & (c - VOXEL < high) for c, low, high in ends]
        clear &= ~(near[0][:, None, None] & near[1][:, None] & near[2])
    return clear


def _is_even(height: Tensor) -> Tensor:
    """Return where a height (H, W) [m] and those of the cells around differ by less than 2 cm."""
    around = F.pad(height[None, None], (1, 1, 1, 1), mode="replicate")
    return (F.max_pool2d(around, 3, 1) + F.max_pool2d(-around, 3, 1))[0, 0] < 0.02
