"""Whether levels cost accuracy where there is one height: the scenes of the accuracy table, mapped with and without.

python -m benchmarks.quality.levels.one_height     # benchmarks/results/levels_accuracy.json and a table
"""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.quality.accuracy.__main__ import cases
from benchmarks.quality.accuracy.recordings import GRID
from benchmarks.quality.accuracy.score import score
from torchelev import ElevationMapConfig, LevelsConfig
from torchelev.app.results import write_json

#: What is compared, and whether more of it is better.
COMPARED = {"rmse": False, "coverage": True}
ALLOWED = 0.02  # share by which a map with levels may be worse


def compare(case: tuple[str, str, str]) -> dict[str, Any]:
    """Return the scores of one case without and with levels."""
    with_levels = ElevationMapConfig(grid=GRID, levels=LevelsConfig())
    one, several = score(*case), score(*case, cfg=with_levels)
    row: dict[str, Any] = {"case": " ".join(case)}
    for name in COMPARED:
        row[name] = [getattr(one, name), getattr(several, name)]
    return row


def worsening(row: dict[str, Any], name: str) -> float:
    """Return the share by which levels make a score worse; negative: better."""
    one, several = row[name]
    change = (several - one) / max(abs(one), 1e-9)
    return -change if COMPARED[name] else change


def table(rows: list[dict[str, Any]]) -> str:
    """Return the cases that levels change by more than 0.1 %, as Markdown."""
    lines = ["| scene, motion, noise | RMSE [cm], 1 and 3 levels | cells known [%] |", "|---|---|---|"]
    for row in rows:
        if max(abs(worsening(row, name)) for name in COMPARED) > 1e-3:
            (a, b), (c, d) = row["rmse"], row["coverage"]
            lines.append(f"| {row['case']} | {a / 10:.2f}, {b / 10:.2f} | {100 * c:.2f}, {100 * d:.2f} |")
    worse = [row["case"] for row in rows if max(worsening(row, name) for name in COMPARED) > ALLOWED]
    lines.append(
        f"\n{len(worse)} of {len(rows)} are worse by more than {100 * ALLOWED:.0f} %: {', '.join(worse) or '-'}"
    )
    return "\n".join(lines)


def main() -> None:
    """Measure, write JSON and print the table."""
    only = sys.argv[1] if len(sys.argv) > 1 else ""
    rows = [compare(case) for case in tqdm(cases(), desc="levels") if only in " ".join(case)]
    print(table(rows))
    if not only:
        write_json(RESULTS / "levels_accuracy.json", {"rows": rows})


if __name__ == "__main__":
    main()
