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
import json
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from typing import Any

import torch

from benchmarks import RESULTS
from benchmarks.quality.levels.maps import BELOW, FREE, OCCUPIED, UNKNOWN, Elevation, Map, OctoMap, Reading, VdbFusion
from benchmarks.quality.levels.scenes import (
    VOXEL,
    WALKS,
    Truth,
    record,
)
from torchelev import LevelsConfig
from torchelev.app.results import markdown_table, write_json

NOISES = {"none": 0.0, "1 cm": 0.01}  # [m] of range
NOISE = "1 cm"  # beside other maps
SCORED, SHARED = 12, 3  # every so many scans are scored, and given to other maps
KINDS: dict[str, LevelsConfig | None] = {"levels": LevelsConfig(), "one surface": None}
CLOSE = 0.3  # [m] by which a ceiling may be wrong
LIBRARIES = ("octomap", "vdbfusion")


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


_SURFACES = {
    "right": ("right %", 100, 2),
    "unknown": ("unknown %", 100, 1),
    "ground_rmse": ("ground [cm]", 100, 2),
    "ceiling_rmse": ("ceiling [cm]", 100, 2),
    "missed": ("missed %", 100, 2),
    "false": ("false %", 100, 2),
    "milliseconds": ("ms", 1, 1),
}  # column: title, scale, digits
_SPACE = {
    "free_as_occupied": ("free called occupied %", 100, 2),
    "free_unknown": ("free unknown %", 100, 1),
    "occupied_as_free": ("occupied called free %", 100, 2),
    "megabytes": ("MB", 1, 1),
}


def _tabulate(walks: dict[str, dict[str, Any]], columns: dict[str, tuple[str, int, int]]) -> str:
    """Tabulate columns of all maps on all walks."""

    def text(value: float | None, scale: int, digits: int) -> str:
        return f"{scale * value:.{digits}f}" if value is not None and math.isfinite(value) else "-"

    rows = [
        [walk, name, *(text(row[key], scale, digits) for key, (_, scale, digits) in columns.items())]
        for walk, maps in walks.items()
        for name, row in maps.items()
    ]
    return markdown_table(["walk", "map", *(title for title, *_ in columns.values())], rows)


def table(result: dict[str, Any]) -> str:
    """Tabulate the surfaces of all walks, those beside other maps, and the space between them."""
    beside = result["beside"]
    parts = [_tabulate(beside, columns) for columns in (_SURFACES, _SPACE)] if beside else []
    return "\n\n".join([_tabulate(result["walks"], _SURFACES), *parts])


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
    path = RESULTS / "levels.json"
    if not arguments.libraries and path.exists():  # keeps the last table beside other maps
        result["beside"] = json.loads(path.read_text())["beside"]
    write_json(path, {"every": SCORED, "shared": SHARED, "threads": torch.get_num_threads()} | result)
    print(table(result))


if __name__ == "__main__":
    main()
