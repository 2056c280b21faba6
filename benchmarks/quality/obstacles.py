"""Measure how cliffs, walls, curbs and stairs are rated, planned over and checked, at cells of 2 to 10 cm.

    python -m benchmarks.quality.obstacles        # benchmarks/results/obstacles.json and a table

Known ground of exact heights, with a straight obstacle across. For each obstacle, the lowest rating of its cells, and
the greatest height [cm] that `plan` crosses, and that `check_path` calls safe on a straight path.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, RobotConfig, TraversabilityConfig
from torchelev.app.results import machine, markdown_table, write_json
from torchelev.pipeline import rate
from torchelev.planning.path_check import check_path
from torchelev.planning.planner import plan

RESULTS = Path(__file__).parents[1] / "results"
RESOLUTIONS = (0.02, 0.04, 0.05, 0.1)  # [m]
HEIGHTS = (0.05, 0.1, 0.12, 0.16, 0.18, 0.2, 0.25, 0.3, 0.4, 0.6, 0.8)  # [m]
RATED = (0.1, 0.12, 0.16, 0.2)  # [m] the heights whose ratings the table shows
SHAPES: dict[str, Callable[[Tensor], Tensor]] = {  # heights by x [m], of an obstacle 1 m high
    "cliff": lambda x: -(x > 0).to(x.dtype),
    "wall": lambda x: ((x > 0) & (x < 0.1)).to(x.dtype),
    "curb": lambda x: (x > 0).to(x.dtype),
    "stairs": lambda x: torch.floor((x + 0.01) / 0.3),
}
HEADS = {
    "default": TraversabilityConfig(),
    "of_robot(step 0.16 m)": TraversabilityConfig.of_robot(RobotConfig(step_height=0.16)),
}
FOOTPRINT = torch.tensor([[0.3, 0.2], [-0.3, 0.2], [-0.3, -0.2], [0.3, -0.2]])


def measure(shape: str, height: float, resolution: float, head: TraversabilityConfig) -> dict[str, Any]:
    """Return the lowest rating across one obstacle, whether `plan` crosses it, and whether `check_path` allows it."""
    grid = GridConfig(resolution=resolution, length_x=3.0, length_y=2.0)
    emap = ElevationMap(ElevationMapConfig(grid=grid, traversability=head))
    x = emap.cell_centers()[..., 0].double()
    emap.state.elevation.copy_(height * SHAPES[shape](x))
    emap.state.validity.fill_(True)
    emap.load_state(rate(emap.state, emap.cfg))
    path = plan(emap, torch.tensor([[-0.8, 0.05]]), torch.tensor([[0.8, 0.05]]))
    along = torch.linspace(-0.8, 0.8, 41)
    poses = torch.stack([along, torch.full_like(along, 0.05), torch.zeros_like(along)], -1)[None]
    check = check_path(emap, poses, FOOTPRINT, samples=4)
    inside = emap.state.traversability[0, x[0, :, 0].abs() < 0.8, 8:-8]
    row = {"obstacle": shape, "height": height, "resolution": resolution, "rating": float(inside.min())}
    return row | {"plan": bool(path.reached), "check": bool(check.safe), "reason": check.explain()[0]}


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate each obstacle: the lowest and highest rating and limit [cm] over all sizes of cells."""
    lines = []
    for head, shape in dict.fromkeys((row["head"], row["obstacle"]) for row in rows):
        found = [row for row in rows if (row["head"], row["obstacle"]) == (head, shape)]
        ratings = [_span([row["rating"] for row in found if row["height"] == h], 2) for h in RATED]
        by_cells = [[row for row in found if row["resolution"] == cells] for cells in RESOLUTIONS]
        limits = [_span([_highest(of_cells, name) for of_cells in by_cells], 0) for name in ("plan", "check")]
        lines.append([head, shape, *ratings, *limits])
    titles = [f"{100 * h:.0f} cm" for h in RATED]
    return markdown_table(["head", "obstacle", *titles, "`plan` [cm]", "`check_path` [cm]"], lines)


def _span(values: list[float], digits: int) -> str:
    """Return the lowest and highest value, or one if they read the same."""
    return " to ".join(dict.fromkeys(f"{value:.{digits}f}" for value in (min(values), max(values))))


def _highest(rows: list[dict[str, Any]], name: str) -> float:
    """Return the height [cm] of the highest obstacle that was crossed, as all lower ones were; 0 for none."""
    return max((100 * row["height"] for row in itertools.takewhile(lambda row: row[name], rows)), default=0.0)


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "obstacles.json", help="JSON file to write.")
def main(out: Path) -> None:
    """Measure, write JSON and print the table."""
    rows = [
        {"head": name} | measure(shape, height, resolution, head)
        for name, head in HEADS.items()
        for shape in SHAPES
        for resolution in RESOLUTIONS
        for height in HEIGHTS
    ]
    write_json(out, {"machine": machine(), "rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
