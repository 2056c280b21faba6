"""Time the completion of a large map and of many small ones, half of whose cells are unknown.

    python -m benchmarks.speed.completion

250 x 250 cells may take 6 ms and 256 maps of 64 x 64 cells 40 ms, on two threads. Writes
benchmarks/results/completion_speed.json.
"""

from __future__ import annotations

from typing import Any

import click
import torch
import torch.nn.functional as F

from benchmarks import RESULTS
from benchmarks.speed.meter import interleaved
from torchelev.app.results import markdown_table, write_json
from torchelev.completion.complete import CompletionInput
from torchelev.completion.net import CompletionNet

SIZES = {"250 x 250": (1, 250), "256 x 64 x 64": (256, 64)}  # maps, cells along each side
_HOLE = 9  # cells, about the width of the holes
_RESOLUTION = 0.04  # [m]


def make_maps(num_maps: int, size: int) -> CompletionInput:
    """Return maps of rough ground, half of whose cells are unknown, in holes; half of these are bounded."""
    g = torch.Generator().manual_seed(0)
    elevation, variance, bounds, age, holes = torch.rand(5, num_maps, size, size, generator=g)
    blurred = F.avg_pool2d(holes[:, None], _HOLE, 1, _HOLE // 2)[:, 0]
    known = blurred > blurred.median()
    return CompletionInput(elevation, known, 1e-3 * variance, elevation + bounds, bounds < 0.5, age)


def measure(seconds: float) -> list[dict[str, Any]]:
    """Time the completions with one and with two threads."""
    net = CompletionNet.from_pretrained().requires_grad_(False)
    maps = {name: make_maps(*size) for name, size in SIZES.items()}

    def completion(layers: CompletionInput) -> Any:
        return lambda: net(*layers, resolution=_RESOLUTION)

    rows = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        times = interleaved({name: completion(layers) for name, layers in maps.items()}, seconds, rounds=5)
        rows += [{"maps": name, "threads": threads, **row} for name, row in times.items()]
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the times [ms]."""
    lines = [[row["maps"], str(row["threads"]), f"{row['median']:.0f}", f"{row['min']:.0f}"] for row in rows]
    return markdown_table(["cells", "threads", "median ms", "min ms"], lines)


@click.command(help=__doc__)
@click.option("--seconds", default=10.0, show_default=True, help="Time per row [s].")
def main(seconds: float) -> None:
    """Measure, write JSON and print the table."""
    with torch.inference_mode():
        rows = measure(seconds)
    write_json(RESULTS / "completion_speed.json", {"rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
