"""Maps that are compared with a map with levels: one surface, OctoMap, VDBFusion."""

from __future__ import annotations

import pickle
import subprocess
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from benchmarks.quality.levels.scenes import (
    FREE_HEIGHT,
    NEAR,
    ORIGIN,
    SHAPE,
    VOXEL,
    WINDOW,
    Scan,
    Truth,
    choose,
    places,
    to_map,
    voxels_of,
)
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LevelsConfig

GRID = GridConfig(resolution=VOXEL, length_x=WINDOW * VOXEL, length_y=WINDOW * VOXEL)
BLIND = LevelsConfig().blind_cells(GRID)
MOST = 6  # surfaces of a cell
FREE, OCCUPIED, UNKNOWN, BELOW = 0, 1, -1, 2
UP = torch.tensor([0, 0, 1])


class Reading(NamedTuple):
    """What a map says of its window."""

    ground: Tensor  #: (H, W) [m], NaN where unknown
    ceiling: Tensor  #: (H, W) [m], inf for none, NaN where unknown
    label: Callable[[Tensor], Tensor]  #: FREE, OCCUPIED, UNKNOWN, or BELOW the ground, of voxels (N, 3)


class Map(Protocol):
    """A map that is compared."""

    seconds: float  #: of the last update

    def update(self, points: Tensor, scan: Scan, dt: float) -> None:
        """Take in points (M, 3) [m] of the sensor frame."""

    def read(self, truth: Truth) -> Reading:
        """Return what it says of the window; of the truth, only where the robot stands is for it."""

    def num_bytes(self) -> int:
        """Return its memory."""


class Elevation:
    """A map of this library."""

    def __init__(self, levels: LevelsConfig | None) -> None:
        self.emap = ElevationMap(ElevationMapConfig(grid=GRID, levels=levels))
        self.seconds = 0.0

    def update(self, points: Tensor, scan: Scan, dt: float) -> None:
        """Take in a scan."""
        start = time.perf_counter()
        self.emap.update(points[None], scan.T_sensor[None], scan.T_base[None], dt=dt)
        self.seconds = time.perf_counter() - start

    def read(self, truth: Truth) -> Reading:
        """Return its layers."""
        ground = self.emap.layer("elevation")[0].double()
        if self.emap.cfg.levels is None:
            ceiling, lower, upper = torch.full_like(ground, torch.inf), ground[None], ground[None]
        else:
            numbers = range(self.emap.cfg.levels.max_levels)
            ceiling = self.emap.layer("ceiling")[0].double()
            lower, upper = (
                torch.stack([self.emap.layer(name, level=k)[0].double() for k in numbers])
                for name in ("underside", "elevation")
            )
            lower = torch.where(lower.isnan(), upper, lower)
        return Reading(ground, ceiling, lambda v: label_by_surfaces(v - truth.first, lower, upper, ground, ceiling))

    def num_bytes(self) -> int:
        """Return the memory of its state."""
        return sum(buffer.nbytes for buffer in self.emap.buffers())


def label_by_surfaces(voxels: Tensor, lower: Tensor, upper: Tensor, ground: Tensor, ceiling: Tensor) -> Tensor:
    """Return labels of voxels (N, 3), numbered from the window's corner, by surfaces (K, H, W) [m], NaN for none."""
    size = torch.tensor(ground.shape)
    inside = ((voxels[:, :2] >= 0) & (voxels[:, :2] < size)).all(-1)
    i, j = voxels[:, :2].clamp(min=0).minimum(size - 1).unbind(-1)
    bottom = VOXEL * voxels[:, 2]
    is_occupied = ((lower[:, i, j] < bottom + VOXEL) & (upper[:, i, j] >= bottom)).any(0)
    middle = bottom + 0.5 * VOXEL
    is_free = (middle > ground[i, j]) & (middle < ceiling[i, j])
    others = torch.where(is_free, FREE, torch.where(middle < ground[i, j], BELOW, UNKNOWN))
    return torch.where(inside, torch.where(is_occupied, OCCUPIED, others), UNKNOWN)


class OctoMap:
    """An octree of pyoctomap."""

    def __init__(self) -> None:
        import pyoctomap

        self.tree, self.seconds = pyoctomap.OcTree(VOXEL), 0.0
        self.ends = torch.zeros(SHAPE, dtype=torch.bool)  # no other voxel can be occupied

    def update(self, points: Tensor, scan: Scan, dt: float) -> None:
        """Take in a scan; of farther points only the rays."""
        placed, origin = to_map(points, scan.T_sensor), scan.T_sensor[:3, 3]
        given = placed.numpy().copy(), origin.numpy().copy()
        start = time.perf_counter()
        self.tree.insertPointCloud(*given, max_range=NEAR)
        self.seconds = time.perf_counter() - start
        near = placed[(placed - origin).norm(dim=-1) <= NEAR + 1e-3]
        self.ends[places(voxels_of(near.float().double()))] = True

    def read(self, truth: Truth) -> Reading:
        """Return the ground and the ceiling among its occupied voxels."""
        H, W = truth.ground.shape
        i, j = (truth.first[:2] + ORIGIN[:2]).tolist()
        ends = self.ends[i : i + H, j : j + W].nonzero()
        occupied = torch.zeros(H, W, SHAPE[2], dtype=torch.bool)
        occupied[tuple(ends.T)] = self._label(ends + truth.first - ORIGIN * UP) == OCCUPIED
        layer = torch.arange(SHAPE[2])
        above = torch.where(occupied, layer, SHAPE[2] + 10**6).flip(-1).cummin(-1).values.flip(-1)
        above = torch.cat([above[..., 1:], torch.full_like(above[..., :1], SHAPE[2] + 10**6)], -1)
        is_top = occupied & (above - layer - 1 >= round(FREE_HEIGHT / VOXEL))
        height = VOXEL * (layer + 1 - ORIGIN[2]).double()
        under = torch.where(above < SHAPE[2], VOXEL * (above - ORIGIN[2]).double(), torch.inf)
        tops, order = torch.where(is_top, height, torch.inf).sort(-1)
        tops, ceilings = tops[..., :MOST].movedim(-1, 0), under.gather(-1, order[..., :MOST]).movedim(-1, 0)
        return Reading(*_ground_of(tops, ceilings, truth), self._label)

    def _label(self, voxels: Tensor) -> Tensor:
        middles = VOXEL * (voxels.double() + 0.5)
        return torch.from_numpy(self.tree.getLabels(middles.numpy())).long()

    def num_bytes(self) -> int:
        """Return the memory of its nodes."""
        return int(self.tree.memoryUsage())


def _ground_of(tops: Tensor, ceilings: Tensor, truth: Truth) -> tuple[Tensor, Tensor]:
    """Return ground and ceiling (H, W) [m] of surfaces (K, H, W), in ascending order, and what is above each."""
    number, ground = choose(tops, truth.foot, truth.cell, BLIND)
    ceiling = ceilings.gather(0, number.clamp(min=0)[None])[0]
    return ground, torch.where(ground.isfinite(), ceiling, torch.nan)


# Runs in another Python: there are wheels of vdbfusion for Python 3.6 to 3.10 only.
VDBFUSION = f"""
import os, pickle, sys, time
import vdbfusion
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
volume, least = vdbfusion.VDBVolume({VOXEL}, {3 * VOXEL}, False), resident()
while True:
    try:
        given = pickle.load(sys.stdin.buffer)
    except EOFError:
        break
    start = time.perf_counter()
    if given is None:
        answer = *volume.extract_triangle_mesh(False, 3.0), resident() - least
    else:
        volume.integrate(*given)
        answer = time.perf_counter() - start
    pickle.dump(answer, sys.stdout.buffer)
    sys.stdout.buffer.flush()
"""


class VdbFusion:
    """A truncated signed distance of VDBFusion, without space carving, as by its defaults."""

    def __init__(self, python: str) -> None:
        pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.process: Any = subprocess.Popen([python, "-c", VDBFUSION], **pipes)  # type: ignore[call-overload]
        self.seconds, self.memory = 0.0, 0

    def _ask(self, given: Any) -> Any:
        pickle.dump(given, self.process.stdin, protocol=4)
        self.process.stdin.flush()
        return pickle.load(self.process.stdout)

    def update(self, points: Tensor, scan: Scan, dt: float) -> None:
        """Take in a scan, without the points that are too far."""
        placed, origin = to_map(points, scan.T_sensor), scan.T_sensor[:3, 3]
        near = placed[(placed - origin).norm(dim=-1) <= NEAR]
        self.seconds = self._ask((near.numpy(), origin.numpy().copy()))

    def read(self, truth: Truth) -> Reading:
        """Return the ground and the ceiling where its mesh crosses the middles of the cells."""
        vertices, triangles, self.memory = self._ask(None)
        heights, is_top = _crossings(torch.from_numpy(vertices), torch.from_numpy(triangles).long(), truth)
        above = torch.cat([heights[1:], torch.full_like(heights[:1], torch.inf)])
        is_ground = is_top & (above - heights >= FREE_HEIGHT)
        tops, order = torch.where(is_ground, heights, torch.inf).sort(0)
        ground, ceiling = _ground_of(tops, above.gather(0, order), truth)
        ceiling = torch.minimum(ceiling, _lowest_above(torch.from_numpy(vertices), ground, truth))
        occupied, none = torch.zeros(SHAPE, dtype=torch.bool), torch.full_like(heights, torch.nan)
        occupied[places(voxels_of(torch.from_numpy(vertices)))] = True

        def label(voxels: Tensor) -> Tensor:
            by_surfaces = label_by_surfaces(voxels - truth.first, none, none, ground, ceiling)
            return torch.where(occupied[places(voxels)], OCCUPIED, by_surfaces)

        return Reading(ground, ceiling, label)

    def num_bytes(self) -> int:
        """Return by how much its process grew until the last reading, and end the process."""
        self.process.stdin.close()
        self.process.wait()
        return self.memory


def _lowest_above(vertices: Tensor, ground: Tensor, truth: Truth) -> Tensor:
    """Return the height of the lowest vertex over each cell that leaves free height, inf for none."""
    H, W = ground.shape
    cell = (vertices[:, :2] / VOXEL).floor().long() - truth.first[:2]
    inside = ((cell >= 0) & (cell < torch.tensor([H, W]))).all(-1)
    flat, z = (cell[:, 0] * W + cell[:, 1])[inside], vertices[inside, 2]
    is_above = z >= ground.flatten()[flat] + FREE_HEIGHT
    lowest = torch.full((H * W,), torch.inf, dtype=torch.float64)
    return lowest.scatter_reduce(0, flat[is_above], z[is_above], "amin").view(H, W)


def _crossings(vertices: Tensor, triangles: Tensor, truth: Truth) -> tuple[Tensor, Tensor]:
    """Return the heights at which a mesh crosses the cells' middles, in ascending order, and where it faces up.

    Marching cubes puts vertices on the lines between the middles of voxels, which are over those of the cells.
    """
    H, W = truth.ground.shape
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    up = torch.zeros(len(vertices), dtype=torch.float64)
    slope = torch.linalg.cross(b - a, c - a)[:, 2]
    for k in range(3):
        up.index_add_(0, triangles[:, k], slope)
    place = vertices[:, :2] / VOXEL - 0.5
    cell = place.round().long() - truth.first[:2]
    chosen = ((place - place.round()).abs() < 1e-3).all(-1) & ((cell >= 0) & (cell < torch.tensor([H, W]))).all(-1)
    flat, z, up = (cell[:, 0] * W + cell[:, 1])[chosen], vertices[chosen, 2], up[chosen]
    order = z.argsort(stable=True)
    order = order[flat[order].argsort(stable=True)]
    flat, z, up = flat[order], z[order], up[order]
    rank = torch.arange(len(flat)) - torch.searchsorted(flat, flat)
    kept = rank < 2 * MOST
    heights = torch.full((2 * MOST, H * W), torch.inf, dtype=torch.float64)
    is_top = torch.zeros_like(heights, dtype=torch.bool)
    heights[rank[kept], flat[kept]], is_top[rank[kept], flat[kept]] = z[kept], up[kept] > 0
    return heights.view(-1, H, W), is_top.view(-1, H, W)
