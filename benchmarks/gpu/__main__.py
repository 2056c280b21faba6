"""Measure one GPU: agreement with the CPU, host synchronisation, and speed beside the memory's bandwidth.

    python -m benchmarks.gpu                # writes benchmarks/results/gpu-NAME.json
    python -m benchmarks.gpu --device cpu   # a dry run: small sizes, no CUDA graph, nothing written

Needs torch, numpy and a CUDA device. Each figure is written as soon as it is measured.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks import RESULTS
from benchmarks.gpu.agreement import correctness, host_never_waits
from benchmarks.gpu.timing import Figure, many_robots, one_robot
from benchmarks.speed.meter import fresh_compiler
from benchmarks.speed.workload import Drive, full_config
from torchelev.app.results import markdown_table, slug, write_json


def verdicts(result: dict[str, Any]) -> list[list[str]]:
    """Return a row for each target that was measured: case, value, limit, verdict."""
    rows = []

    def check(case: str, value: float, limit: float, unit: str) -> None:
        rows.append([case, f"{value:.3f} {unit}", f"<= {limit} {unit}", "met" if value <= limit else "missed"])

    def fastest(*names: str) -> float | None:
        return min((result[name]["median"] for name in names if "median" in result.get(name, {})), default=None)

    repeats = result["correctness"].get("run to run, deterministic", {}).get("largest_difference_m", math.inf)
    check("largest difference between deterministic runs", repeats, 0, "m")
    waits = sum("error" in values for name, values in result.items() if name.startswith("host never waits"))
    check("kinds of update for which the host waits", waits, 0, "")
    one, scans = fastest("one robot, captured"), fastest("height scans", "height scans, compiled")
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


def _figures(device: str, seconds: float, dry: bool) -> Iterator[Figure]:
    """Yield all figures with the calls that measure them."""
    yield "correctness", lambda: correctness(device)
    for compiled in () if dry else (False, True):
        fresh_compiler()
        drive = Drive(full_config(64), 1024, robots=8, device=device, compiled=compiled)
        name = f"host never waits, {'compiled' if compiled else 'eager'}"
        yield name, partial(host_never_waits, drive)
    yield from one_robot(device, seconds)
    yield from many_robots(device, *((8, 512) if dry else (4096, 3072)), seconds)


def main() -> int:
    """Measure, write JSON and print the verdicts; a figure that fails is recorded with its error."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"), help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="time per figure [s] (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="output folder (default: benchmarks/results)")
    args = parser.parse_args()
    dry = args.device == "cpu"
    if not dry and not torch.cuda.is_available():
        parser.error("there is no CUDA device; use --device cpu for a dry run")
    result: dict[str, Any] = {}
    for name, measure in _figures(args.device, args.seconds, dry):
        try:
            result[name] = measure()
        except RuntimeError as error:
            result[name] = {"error": str(error)[:500]}
        print(f"{name}: {json.dumps(result[name])[:300]}", flush=True)
        if not dry:
            write_json(args.out / f"gpu-{slug(torch.cuda.get_device_name())}.json", result)
    if dry:
        print("dry run: nothing is checked or written")
        return 0
    rows = verdicts(result)
    print(markdown_table(["case", "measured", "target", ""], rows))
    return int(any(row[-1] == "missed" for row in rows) or any("error" in str(values) for values in result.values()))


if __name__ == "__main__":
    sys.exit(main())
