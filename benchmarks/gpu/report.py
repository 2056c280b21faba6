"""Tables of the figures of a GPU: the times, and whether they meet their targets."""

from __future__ import annotations

import math
from typing import Any

from torchelev.app.results import markdown_table

_CASES = {
    "update: one robot, 43,074 points, 250 x 250 cells": "one robot",
    "update: 4096 robots, 3072 points each, 64 x 64 cells": "many robots",
    "height scans: 4096 robots, 187 points each": "height scans",
}
# How a case may be run: the endings of the names of its figures.
_UNCOMPILED, _COMPILED, _CAPTURED = (", eager", ""), (", compiled", ", update"), (", captured",)


def table(result: dict[str, Any]) -> str:
    """Tabulate the times [ms]: median (fastest)."""

    def cell(case: str, endings: tuple[str, ...]) -> str:
        found = [result[case + ending] for ending in endings if "median" in result.get(case + ending, {})]
        return f"{found[0]['median']:.3g} ({found[0]['min']:.3g})" if found else "–"

    kinds = (_UNCOMPILED, _COMPILED, _CAPTURED)
    rows = [[title, *(cell(case, endings) for endings in kinds)] for title, case in _CASES.items()]
    device = result["machine"]["device"]
    return markdown_table([f"{device}, ms: median (fastest)", "uncompiled", "compiled", "CUDA graph"], rows)


def costs(result: dict[str, Any]) -> str:
    """Tabulate an update of many robots beside a copy of its bytes, and its longest kernels."""
    num_bytes, robots = result["many robots, expected bytes"], result["many robots"]["robots"]
    copied, update = 1e3 * num_bytes / result["copy, bytes per second"], result["many robots, captured"]["median"]
    rows = [
        ["copy of points, map and table", f"{num_bytes / 1e9:.1f} GB, {copied:.1f} ms"],
        ["update, captured", f"{update:.1f} ms, {update / copied:.0f} times the copy"],
        ["memory per robot", f"{result['many robots, bytes per robot'] / 1e3:.0f} kB"],
    ]
    kernels = list(result["many robots, slowest kernels"].items())[:4]
    rows += [[f"kernel `{name.split(' ')[0]}`", f"{time:.2f} ms"] for name, time in kernels]
    return markdown_table([f"{robots:,} robots", ""], rows)


def verdicts(result: dict[str, Any]) -> list[list[str]]:
    """Return a row for each target that was measured: case, value, limit, verdict."""
    rows = []

    def check(case: str, value: float, limit: float, unit: str) -> None:
        rows.append([case, f"{value:.3f} {unit}", f"<= {limit} {unit}", "met" if value <= limit else "missed"])

    def fastest(*names: str) -> float | None:
        return min((result[name]["median"] for name in names if "median" in result.get(name, {})), default=None)

    if "correctness" in result:
        repeats = result["correctness"].get("run to run, deterministic", {}).get("largest_difference_m", math.inf)
        check("largest difference between deterministic runs", repeats, 0, "m")
    waits = ["error" in values for name, values in result.items() if name.startswith("host never waits")]
    if waits:
        check("kinds of update for which the host waits", sum(waits), 0, "")
    one, scans = fastest("one robot, captured"), fastest("height scans", "height scans, captured")
    many = fastest("many robots, update", "many robots, captured")
    if one is not None:
        check("one robot, captured", one, 0.3, "ms")
    if many is not None:
        check("many robots", many, 5.0, "ms")
        bytes_take = 1e3 * result["many robots, expected bytes"] / result["copy, bytes per second"]
        check("many robots, over what their bytes take", many / bytes_take, 5.0, "x")
    if scans is not None:
        check("height scans", scans, 0.1, "ms")
    return rows
