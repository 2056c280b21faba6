"""Measure one GPU: agreement with the CPU, host synchronisation, and speed beside the memory's bandwidth.

    python -m benchmarks.gpu                # writes benchmarks/results/gpu-NAME.json
    python -m benchmarks.gpu --device cpu   # a dry run: small sizes, no CUDA graph, nothing written

Needs torch, numpy and a CUDA device. Each figure is written as soon as it is measured.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks import RESULTS
from benchmarks.gpu.agreement import correctness, host_never_waits
from benchmarks.gpu.report import verdicts
from benchmarks.gpu.timing import Figure, many_robots, one_robot
from benchmarks.speed.common.workload import Drive, full_config
from torchelev.app.results import markdown_table, slug, write_json


def _agreement(device: str, seconds: float) -> Iterator[Figure]:
    yield "correctness", lambda: correctness(device)
    for compiled in () if device == "cpu" else (False, True):
        drive = Drive(full_config(64), 1024, robots=8, device=device, compiled=compiled)
        name = f"host never waits, {'compiled' if compiled else 'eager'}"
        yield name, partial(host_never_waits, drive)


PARTS = {"agreement": _agreement, "one": one_robot, "many": many_robots}


def main() -> int:
    """Measure, write JSON and print the verdicts; a figure that fails is recorded with its error."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"), help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="time per figure [s] (default: %(default)s)")
    parser.add_argument("--only", default=list(PARTS), nargs="+", choices=PARTS, help="parts (default: all)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="output folder (default: benchmarks/results)")
    args = parser.parse_args()
    dry = args.device == "cpu"
    if not dry and not torch.cuda.is_available():
        parser.error("there is no CUDA device; use --device cpu for a dry run")
    result: dict[str, Any] = {}
    figures = itertools.chain.from_iterable(PARTS[part](args.device, args.seconds) for part in args.only)
    for name, measure in figures:
        try:
            result[name] = measure()
        except Exception as error:  # what one figure lacks, the others do not
            result[name] = {"error": f"{type(error).__name__}: {error}"[:500]}
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
