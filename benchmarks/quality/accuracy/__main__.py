"""Compare the map with the ground truth, beside the per-cell mean and maximum of the same points.

    python -m benchmarks.quality.accuracy            # benchmarks/results/accuracy.json, accuracy.png and a table

The scenes are closed-form. Their sensors: a depth camera of 160 x 120 pixels (86 x 58 degrees, pitched down by 35
degrees) at 0.8 m, turning on the spot; the same camera on a walk with roll, pitch and bob; and a lidar of 32 rings.
Each recording is mapped without noise, with noise, and with 8 % of the ranges wrong. Scored are the cells within 2.5 m
of the robot's last position, against the true height at the cell center.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.quality.accuracy.recordings import GRID, NOISES, SCENES
from benchmarks.quality.accuracy.report import plot, table
from benchmarks.quality.accuracy.score import meets, score
from torchelev import ElevationMapConfig
from torchelev.app.results import write_json


def cases() -> list[tuple[str, str, str]]:
    """Return the combinations of scene, motion and noise."""
    return [(s, m, n) for m in ("turn", "walk", "lidar") for s in SCENES for n in NOISES]


def main() -> None:
    """Measure, write JSON and figure and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality.accuracy",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="output folder (default: benchmarks/results)")
    only_help = "score only the rows that contain this text, such as 'stairs turn', and write nothing"
    parser.add_argument("--only", default="", help=only_help)
    args = parser.parse_args()
    chosen = [case for case in cases() if args.only in " ".join(case)]
    rows = [score(*case) for case in tqdm(chosen, desc="accuracy")]
    print(table(rows))
    if not args.only:
        values = [asdict(r) | {"holds": meets(r)} for r in rows]
        write_json(args.out / "accuracy.json", {"config": ElevationMapConfig(grid=GRID).to_dict(), "rows": values})
        plot(args.out / "accuracy.png", rows)


if __name__ == "__main__":
    main()
