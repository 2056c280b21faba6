"""Speed and scale on this machine: time, memory and growth of an update, start-up, and whether the targets are met.

    python -m benchmarks.speed.run                      # all sections, under ten minutes: JSON, plots, tables
    python -m benchmarks.speed.run points robots        # these sections alone; the others stay as they were
    python -m benchmarks.speed.run --against old.json   # measure, and flag what became slower
    python -m benchmarks.speed.run --compare new.json --against old.json    # compare two files without measuring

Each finished section is written at once; --resume goes on with the sections missing from this commit's file.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.speed import meter
from benchmarks.speed import plots as speed_plots
from benchmarks.speed import tables as speed_tables
from benchmarks.speed.sections import SECTIONS, fresh_compiler
from benchmarks.speed.workload import full_config
from torchelev.app.results import commit, machine, slug, write_json

SLOWER = 1.3  # a ratio of times above it is a regression, if medians and minima agree on it


def default_path(folder: str) -> Path:
    """Return where this machine's result lies: one file per processor and number of threads."""
    return Path(folder) / f"speed-{slug(machine()['processor'])}-{torch.get_num_threads()}-threads.json"


def measure(path: Path, names: list[str], seconds: float, resume: bool) -> dict[str, Any]:
    """Run sections, writing the file after each."""
    result = json.loads(path.read_text()) if path.exists() else {}
    result["copy_gigabytes_per_second"] = meter.copy_bandwidth() / 1e9
    result["config"] = full_config().to_dict()
    for name in names:
        stamp = {"commit": commit(), "seconds": seconds}
        measured = result.setdefault("measured", {})
        known = stamp["commit"] != "unknown" and "+" not in stamp["commit"]
        if resume and known and measured.get(name) == stamp:
            print(f"{name}: measured at {stamp['commit']}, skipped", file=sys.stderr)
            continue

        def track(values: Iterable, name: str = name) -> Iterator:
            yield from tqdm(list(values), desc=name, disable=None, leave=False)

        fresh_compiler()
        result[name] = SECTIONS[name](seconds, track)
        measured[name] = stamp
        write_json(path, result)
    return json.loads(path.read_text())  # with the machine


def timings(values: Any, path: str = "") -> Iterator[tuple[str, dict[str, float]]]:
    """Find every time in a result, with its place."""
    if isinstance(values, dict):
        if {"median", "min"} <= values.keys():
            yield path, values
        for name, value in values.items():
            yield from timings(value, f"{path}/{name}")
    elif isinstance(values, list):
        for value in (v for v in values if isinstance(v, dict)):
            key = next((f"{k} {value[k]}" for k in ("points", "robots", "cells", "metres") if k in value), "?")
            yield from timings(value, f"{path}/{key}")


def regressions(new: dict[str, Any], old: dict[str, Any], limit: float = SLOWER) -> tuple[list[str], int]:
    """List what takes more than `limit` times as long as before, and count what could be compared.

    Both median and minimum must say so: one alone is noise.
    """
    before = dict(timings(old))
    common = [(place, time, before[place]) for place, time in timings(new) if place in before]
    slower = []
    for place, now, then in common:
        ratios = {kind: now[kind] / then[kind] for kind in ("median", "min")}
        if min(ratios.values()) > limit:
            changes = [f"{kind} {then[kind]:.3f} -> {now[kind]:.3f} ms ({ratios[kind]:.2f} x)" for kind in ratios]
            slower.append(f"{place}: {', '.join(changes)}")
    return slower, len(common)


def compare(new: dict[str, Any], old: dict[str, Any], name: Path) -> int:
    """Print what became slower; return 1 if something did, 2 if nothing could be compared."""
    slower, count = regressions(new, old)
    print(f"\n{len(slower)} of {count} times are more than {SLOWER} times as long as in {name}", *slower, sep="\n")
    return 2 if count == 0 else int(bool(slower))


def existing(path: str) -> Path:
    """Accept the path of a file that exists."""
    if not Path(path).is_file():
        raise argparse.ArgumentTypeError(f"no such file: {path}")
    return Path(path)


def main() -> int:
    """Measure, write JSON, plots and tables; with --against, fail if something became slower."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}; default: all")
    parser.add_argument("--out", default="benchmarks/results", help="folder for the results (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="time for each figure [s] (default: %(default)s)")
    parser.add_argument(
        "--resume", action="store_true", help="skip the sections measured at this commit for as many --seconds"
    )
    parser.add_argument("--against", type=existing, metavar="OLD.json", help="flag what became slower than there")
    parser.add_argument(
        "--compare", type=existing, metavar="NEW.json", help="measure nothing, compare this with --against"
    )
    args = parser.parse_args()
    unknown = [name for name in args.sections if name not in SECTIONS]
    if unknown:
        parser.error(f"unknown section {', '.join(unknown)}: there are {', '.join(SECTIONS)}")
    if args.compare and not args.against:
        parser.error("--compare needs --against OLD.json")
    old = json.loads(args.against.read_text()) if args.against else None
    if args.compare:
        return compare(json.loads(args.compare.read_text()), old, args.against)
    torch.set_num_threads(args.threads)
    path = default_path(args.out)
    names = args.sections or list(SECTIONS)
    try:
        result = measure(path, names, args.seconds, args.resume)
    except KeyboardInterrupt:
        print(f"\ninterrupted: finished sections are in {path}; --resume goes on", file=sys.stderr)
        return 130
    speed_plots.draw(result, path.with_suffix(".png"))
    print(f"{speed_tables.report(result)}\n\nwrote {path} and its picture")
    return compare({name: result[name] for name in names}, old, args.against) if old is not None else 0


if __name__ == "__main__":
    sys.exit(main())
