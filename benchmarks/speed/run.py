"""Measure speed and scaling on this machine, and check the targets.

    python -m benchmarks.speed.run                      # all sections, a quarter of an hour: JSON, plots, tables
    python -m benchmarks.speed.run points robots        # only these sections; the others keep their results
    python -m benchmarks.speed.run --against old.json   # measure and report regressions
    python -m benchmarks.speed.run --compare new.json --against old.json    # compare two files, measure nothing

Each section is written as soon as it is finished; --resume measures only the sections that this commit's file lacks.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks import RESULTS
from benchmarks.speed.common import meter
from benchmarks.speed.common.workload import full_config
from benchmarks.speed.update import plots, tables
from benchmarks.speed.update.sections import SECTIONS
from torchelev.app.results import commit, machine, slug, write_json

Sections = Mapping[str, Callable[[float], dict[str, Any]]]
SLOWER = 1.3  # ratio of times above which both medians and minima must lie for a regression


def _path(folder: Path) -> Path:
    """Return the path of this machine's result: one file per processor and number of threads."""
    return folder / f"speed-{slug(machine()['processor'])}-{torch.get_num_threads()}-threads.json"


def measure(
    path: Path, names: list[str], seconds: float, resume: bool, sections: Sections = SECTIONS
) -> dict[str, Any]:
    """Run sections and write the file after each."""
    result = json.loads(path.read_text()) if path.exists() else {}
    result["copy_gigabytes_per_second"] = meter.copy_bandwidth() / 1e9
    result["config"] = full_config().to_dict()
    for name in names:
        revision = commit()
        stamp = {"commit": revision, "seconds": seconds}
        measured = result.setdefault("measured", {})
        is_reproducible = revision != "unknown" and "+" not in revision
        if resume and is_reproducible and measured.get(name) == stamp:
            print(f"{name}: measured at {revision}, skipped", file=sys.stderr)
            continue
        result[name] = sections[name](seconds)
        measured[name] = stamp
        write_json(path, result)
    return json.loads(path.read_text())  # includes the machine


def timings(values: Any, path: str = "") -> Iterator[tuple[str, dict[str, float]]]:
    """Yield every time of a result with its path."""
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
    """Describe each time that grew by more than the factor `limit`, and count the times that both results hold.

    Both median and minimum must have grown: one alone is noise.
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
    """Print the regressions; return 1 if there are any, 2 if nothing could be compared."""
    slower, count = regressions(new, old)
    print(f"\n{len(slower)} of {count} times grew by more than a factor of {SLOWER} since {name}", *slower, sep="\n")
    return 2 if count == 0 else int(bool(slower))


def _existing(path: str) -> Path:
    """Accept only the path of an existing file."""
    if not Path(path).is_file():
        raise argparse.ArgumentTypeError(f"no such file: {path}")
    return Path(path)


def main(argv: Sequence[str] | None = None, sections: Sections = SECTIONS) -> int:
    """Measure, write JSON, plots and tables; with --against, fail on a regression."""
    args = _arguments(argv)
    if args.compare:
        return compare(json.loads(args.compare.read_text()), json.loads(args.against.read_text()), args.against)
    torch.set_num_threads(args.threads)
    path = _path(args.out)
    old = json.loads(args.against.read_text()) if args.against else None  # read first: it may be the file written below
    names = args.sections or list(SECTIONS)
    try:
        result = measure(path, names, args.seconds, args.resume, sections)
    except KeyboardInterrupt:
        print(f"\ninterrupted: finished sections are in {path}; continue with --resume", file=sys.stderr)
        return 130
    plots.draw(result, path.with_suffix(".png"))
    print(f"{tables.report(result)}\n\nwrote {path} and its picture")
    return compare({name: result[name] for name in names}, old, args.against) if old is not None else 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed.run",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"any of {', '.join(SECTIONS)} (default: all)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="output folder (default: benchmarks/results)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="time per row [s] (default: %(default)s)")
    parser.add_argument(
        "--resume", action="store_true", help="skip sections measured at this commit with these --seconds"
    )
    parser.add_argument("--against", type=_existing, metavar="OLD.json", help="report regressions since this result")
    parser.add_argument("--compare", type=_existing, metavar="NEW.json", help="measure nothing; compare with --against")
    args = parser.parse_args(argv)
    unknown = [name for name in args.sections if name not in SECTIONS]
    if unknown:
        parser.error(f"unknown section {', '.join(unknown)}; choose from {', '.join(SECTIONS)}")
    if args.compare and not args.against:
        parser.error("--compare needs --against OLD.json")
    return args


if __name__ == "__main__":
    sys.exit(main())
