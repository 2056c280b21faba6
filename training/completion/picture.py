"""A figure of maps, their completions and the standard deviations.

    python -m training.completion.picture

redraws training/results/completion.png with the shipped weights.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import torch
from torch import Tensor

from torchelev.completion.net import CompletionNet
from torchelev.viz.style import HEIGHTS, RATINGS, draw_cells, make_figure, save, styled
from training import RESULTS
from training.completion.evaluate import fill
from training.completion.maps import TrueMap, WalkConfig, Walks, make_walks
from training.options import jobs_option

KINDS = ("stairs_down", "stairs_up", "obstacles", "gaps")  # the last one shows where it fails
_SCANS = 3  # after which the maps are drawn
_RESOLUTION = 0.04  # [m]
_LIMIT = 0.2  # [m] of errors and standard deviations that are drawn
TITLES = ("map", "completed", "minimum", "truth", "standard\ndeviation", "error")


class Row(NamedTuple):
    """The layers of one map to draw, (H, W) each."""

    heights: tuple[Tensor, ...]  #: [m] NaN where unknown
    deviations: tuple[Tensor, ...]  #: [m] 0 and above


@torch.no_grad()
def make_row(net: CompletionNet, maps: TrueMap, number: int) -> Row:
    """Return the layers of a map to draw."""
    mean, std = net(*maps.layers, resolution=maps.resolution)
    minimum, _ = fill("minimum")(maps)
    known = torch.where(maps.layers.validity, maps.layers.elevation, torch.nan)
    heights = (known, mean, minimum, maps.truth)
    blank = ~maps.is_inside[number]
    shown = [layer[number].masked_fill(blank, torch.nan) for layer in (*heights, std, (mean - maps.truth).abs())]
    return Row(tuple(shown[:4]), tuple(shown[4:]))


@styled()
def draw(rows: dict[str, Row], path: Path) -> None:
    """Draw a row for each kind of ground."""
    figure = make_figure(1.55 * len(TITLES), 1.55 * len(rows) + 1.2)
    axes = figure.subplots(len(rows), len(TITLES), squeeze=False)
    images: list[Any] = []
    for line, (kind, row) in zip(axes, rows.items(), strict=True):
        low, high = (float(f(row.heights[3][~row.heights[3].isnan()])) for f in (torch.min, torch.max))
        images = [_panel(ax, values, HEIGHTS, low, high) for ax, values in zip(line, row.heights, strict=False)]
        images += [_panel(ax, v, RATINGS, 0.0, _LIMIT) for ax, v in zip(line[4:], row.deviations, strict=True)]
        line[0].set_ylabel(kind.replace("_", " "))
    for ax, title in zip(axes[0], TITLES, strict=True):
        ax.set_title(title)
    bar = figure.colorbar(images[0], ax=axes[:, :4], location="bottom", aspect=30, pad=0.02, ticks=[])
    bar.set_label("elevation, low to high; grey: unknown")
    bar = figure.colorbar(images[-1], ax=axes[:, 4:], location="bottom", aspect=15, pad=0.02)
    bar.set_label("[m]")
    save(figure, path)


def _panel(ax: Any, values: Tensor, colors: Any, low: float, high: float) -> Any:
    ax.set(xticks=[], yticks=[])
    shown = np.ma.masked_invalid(values.double().numpy())
    return draw_cells(ax, shown, (0, 1, 0, 1), colors, vmin=low, vmax=high)


@click.command(help=__doc__)
@click.option(
    "--weights", type=click.Path(path_type=Path, exists=True), default=None, help="Default: the shipped ones."
)
@click.option("--data", type=click.Path(path_type=Path), default=Path("runs/completion/data"), show_default=True)
@click.option("--walks", type=click.IntRange(1), default=8, show_default=True, help="To choose the first maps from.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "completion.png", help="File to write.")
@jobs_option
def main(weights: Path | None, data: Path, walks: int, out: Path, jobs: int) -> None:
    """Draw held-out maps."""
    net = CompletionNet.from_pretrained(weights)
    held_out = Walks(data, "held_out", 0, WalkConfig(), _RESOLUTION)
    make_walks(held_out, walks, jobs)
    found: dict[str, Row] = {}
    for index in range(walks):
        for maps in held_out.read(index):
            for number, kind in enumerate(maps.kinds):
                if maps.scans == _SCANS and kind in KINDS and kind not in found:
                    found[kind] = make_row(net, maps, number)
    draw({kind: found[kind] for kind in KINDS if kind in found}, out)
    click.echo(f"Wrote {out}.")


if __name__ == "__main__":
    main()
