"""How right the ground and the ceiling are where something is above or below: a map with levels, and one without.

    python -m benchmarks.quality.levels                   # benchmarks/results/levels.json and a table
    python -m benchmarks.quality.levels --with octomap    # a second table: other maps of the same scans
    python -m benchmarks.quality.levels --with vdbfusion --python <an interpreter that has vdbfusion>

A robot with a lidar walks through a scene. Every 12th scan is scored, on the cells whose true ground is even and was
hit by 3 points since it entered the window: the share whose elevation is that of the right surface, and the RMSE of
these. A ceiling is missed if its underside was hit by 3 points and the map has none within 0.3 m above it, and false if
the map has one 0.3 m below it; the RMSE is that of the others.

Beside other maps, every map gets every third scan. From voxels of 5 cm the ground is found as the truth is: by a way
from where the robot stands over surfaces with 0.4 m of free height, and over at most 0.5 m of unknown cells. Of
OctoMap a surface is the top of an occupied voxel; of VDBFusion, whose voxels cannot be read, the height at which its
mesh crosses the middle of a cell, and what is lowest over the cell is its ceiling. Free space counts if it is a voxel
or more from anything. It is called occupied if its own voxel is. Occupied space is called free if its voxel is, and
none of the six around is occupied or below the ground. By a map of surfaces, the voxels of surfaces are occupied and
those between ground and ceiling are free; with one surface, all above it are.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import pickle
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from benchmarks import RESULTS
from benchmarks.quality.levels_scenes import (
    FREE_HEIGHT,
    NEAR,
    ORIGIN,
    SHAPE,
    VOXEL,
    WALKS,
    WINDOW,
    Scan,
    Truth,
    choose,
    places,
    record,
    to_map,
    voxels_of,
)
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LevelsConfig
from torchelev.app.results import markdown_table, write_json

GRID = GridConfig(resolution=VOXEL, length_x=WINDOW * VOXEL, length_y=WINDOW * VOXEL)
NOISES = {"none": 0.0, "1 cm": 0.01}  # [m] of range
NOISE = "1 cm"  # beside other maps
SCORED, SHARED = 12, 3  # every so many scans are scored, and given to other maps
KINDS: dict[str, LevelsConfig | None] = {"levels": LevelsConfig(), "one surface": None}
BLIND = LevelsConfig().blind_cells(GRID)
CLOSE = 0.3  # [m] by which a ceiling may be wrong
LIBRARIES = ("octomap", "vdbfusion")
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


def tally(reading: Reading, truth: Truth, with_voxels: bool) -> Counter[str]:
    """Return the sums of one scored scan."""
    sums: Counter[str] = Counter()
    error = reading.ground - truth.ground
    nearest = (truth.tops - reading.ground).abs().amin(0)
    known = truth.counts & reading.ground.isfinite()
    right = known & (error.abs() <= nearest + VOXEL)
    sums.update(scans=1, cells=int(truth.counts.sum()), known=int(known.sum()), right=int(right.sum()))
    sums["ground"] += float(error[right].square().sum())  # type: ignore[assignment]
    above = reading.ceiling - truth.ceiling
    told, hit = right & ~reading.ceiling.isnan() & truth.ceiling_even, right & truth.ceiling_hit
    close = told & (above.abs() <= CLOSE)  # not where both are infinite
    sums.update(ceilings=int(hit.sum()), told=int(told.sum()), close=int(close.sum()))
    sums["missed"] += int((hit & ~(reading.ceiling <= truth.lowest + CLOSE)).sum())
    sums["false"] += int((told & (reading.ceiling < truth.ceiling - CLOSE)).sum())
    sums["ceiling"] += float(above[close].square().sum())  # type: ignore[assignment]
    if with_voxels:
        free = reading.label(truth.free)
        lost = reading.label(truth.occupied) == FREE
        around = torch.cat([torch.eye(3, dtype=torch.int64), -torch.eye(3, dtype=torch.int64)])
        beside = reading.label((truth.occupied[lost][:, None] + around).flatten(0, 1)).view(-1, 6)
        sums.update(free=len(free), free_as_occupied=int((free == OCCUPIED).sum()))
        sums.update(free_unknown=int(((free == UNKNOWN) | (free == BELOW)).sum()), occupied=len(lost))
        sums["occupied_as_free"] += int(((beside == FREE) | (beside == UNKNOWN)).all(-1).sum())
    return sums


def summarize(sums: Counter[str]) -> dict[str, Any]:
    """Return shares, RMSE [m] and times [ms] of sums."""

    def share(part: str, whole: str) -> float:
        return sums[part] / sums[whole] if sums[whole] else math.nan

    result = {
        "cells": round(sums["cells"] / sums["scans"]),
        "right": share("right", "known"),
        "unknown": 1 - share("known", "cells"),
        "ground_rmse": math.sqrt(share("ground", "right")),
        "ceiling_rmse": math.sqrt(share("ceiling", "close")),
        "ceilings": round(sums["ceilings"] / sums["scans"]),
        "missed": share("missed", "ceilings"),
        "false": share("false", "told"),
        "milliseconds": 1e3 * share("seconds", "updates"),
    }
    for part, whole in (("free_as_occupied", "free"), ("free_unknown", "free"), ("occupied_as_free", "occupied")):
        result |= {part: share(part, whole)} if sums["free"] else {}
    return result | ({"megabytes": sums["bytes"] / 1e6} if sums["bytes"] else {})


def run(walk: str, maps: dict[str, Map], noises: dict[str, float], stride: int) -> dict[str, Counter[str]]:
    """Return the sums of a walk for each map, which gets every `stride`-th scan, with noise of the range [m]."""
    sums: dict[str, Counter[str]] = {name: Counter() for name in maps}
    generator = torch.Generator().manual_seed(0)
    own = next(emap.emap for emap in maps.values() if isinstance(emap, Elevation))
    for scan in record(WALKS[walk], stride, SCORED):
        drawn = torch.randn(len(scan.points), 1, generator=generator)
        along = drawn * scan.points / scan.points.norm(dim=-1, keepdim=True).clamp(min=1e-3)
        for name, emap in maps.items():
            emap.update(scan.points + noises[name] * along, scan, dt=0.1 * stride)
            sums[name].update({"updates": 1})
            sums[name]["seconds"] += emap.seconds  # type: ignore[assignment]
        if scan.truth:
            truth = scan.truth(own.cell_centers()[0])
            for name, emap in maps.items():
                sums[name] += tally(emap.read(truth), truth, stride > 1)
    for name, emap in maps.items():
        sums[name]["bytes"] = emap.num_bytes()
    return sums


def _others(libraries: Iterable[str], python: str) -> dict[str, Map]:
    """Return maps that share scans with other libraries' maps; none without these."""
    made: dict[str, Map] = {}
    for library in libraries:
        made |= {"OctoMap": OctoMap()} if library == "octomap" else {"VDBFusion": VdbFusion(python)}
    return {name: Elevation(levels) for name, levels in KINDS.items()} | made if made else {}


def measure(libraries: Iterable[str], python: str) -> dict[str, Any]:
    """Return what each map scores on each walk."""
    walks, beside = {}, {}
    totals: dict[str, Counter[str]] = {}
    for walk in WALKS:
        maps: dict[str, Map] = {f"{kind}, {noise}": Elevation(KINDS[kind]) for noise in NOISES for kind in KINDS}
        noises = {name: NOISES[name.split(", ")[1]] for name in maps}
        walks[walk] = {name: summarize(sums) for name, sums in run(walk, maps, noises, 1).items()}
        others = _others(libraries, python)
        if others:
            found = run(walk, others, dict.fromkeys(others, NOISES[NOISE]), SHARED)
            beside[walk] = {name: summarize(sums) for name, sums in found.items()}
            for name, sums in found.items():
                total = totals.setdefault(name, Counter())
                most = max(total["bytes"], sums["bytes"])
                total.update(sums)
                total["bytes"] = most
    beside |= {"all": {name: summarize(total) for name, total in totals.items()}} if totals else {}
    return {"walks": walks, "beside": beside}


def _cells(row: dict[str, Any], extra: bool) -> list[str]:
    """Return a row of the table."""

    def text(name: str, scale: float, digits: int) -> str:
        return f"{scale * row[name]:.{digits}f}" if row[name] is not None and math.isfinite(row[name]) else "-"

    columns = [("right", 100, 2), ("unknown", 100, 1), ("ground_rmse", 100, 2), ("ceiling_rmse", 100, 2)]
    columns += [("missed", 100, 2), ("false", 100, 2)]
    if extra:
        columns += [("free_as_occupied", 100, 2), ("free_unknown", 100, 1), ("occupied_as_free", 100, 2)]
        columns += [("megabytes", 1, 1)]
    return [text(*column) for column in [*columns, ("milliseconds", 1, 1)]]


def table(result: dict[str, Any]) -> str:
    """Tabulate all walks, and those beside other maps."""
    head = ["right surface %", "unknown %", "ground RMSE [cm]", "ceiling RMSE [cm]", "ceilings missed %", "false %"]
    extra = ["free called occupied %", "free unknown %", "occupied called free %", "MB"]
    tables = []
    for key, names in (("walks", [*head, "ms"]), ("beside", [*head, *extra, "ms"])):
        rows = [
            [walk, name, *_cells(row, key == "beside")]
            for walk, maps in result[key].items()
            for name, row in maps.items()
        ]
        tables += [markdown_table(["walk", "map", *names], rows)] if rows else []
    return "\n\n".join(tables)


def main() -> None:
    """Measure, write JSON and print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality.levels",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--with", dest="libraries", action="append", choices=LIBRARIES, default=[], help="other maps")
    parser.add_argument(
        "--python", default=sys.executable, help="an interpreter that has vdbfusion (default: this one)"
    )
    arguments = parser.parse_args()
    if "octomap" in arguments.libraries and importlib.util.find_spec("pyoctomap") is None:
        parser.error("--with octomap: needs the package pyoctomap, got none; pip install pyoctomap")
    if "vdbfusion" in arguments.libraries and subprocess.run([arguments.python, "-c", "import vdbfusion"]).returncode:
        parser.error("--with vdbfusion: needs the package vdbfusion, got none; give --python one that has it")
    result = measure(arguments.libraries, arguments.python)
    write_json(
        RESULTS / "levels.json", {"every": SCORED, "shared": SHARED, "threads": torch.get_num_threads()} | result
    )
    print(table(result))


if __name__ == "__main__":
    main()
