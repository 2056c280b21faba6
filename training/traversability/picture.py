"""A figure of maps, their labels and the ratings of the heads.

    python -m training.traversability.picture

redraws training/results/traversability.png with the shipped weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torchelev.traversability.net import TraversabilityNet
from torchelev.viz.palette import HEIGHTS, RATINGS
from torchelev.viz.style import draw_cells, make_figure, styled, write
from training import RESULTS
from training.options import paper_weights_option
from training.traversability.heads import Score, baselines
from training.traversability.maps.data import MappedTerrain, data_set
from training.traversability.maps.mapping import DataConfig
from training.traversability.maps.terrain import KINDS

PICTURED_KINDS = ("gaps", "obstacles", "stairs_up", "stairs_down")  # where the heads differ most
PICTURED_HEADS = ("analytic (defaults)", "paper (at 4 cm)")
_ELEVATION = "elevation"
Layers = dict[str, tuple[Tensor, Tensor]]  # values and mask of the cells to show, (H, W) each


@torch.no_grad()
def _layers(net: TraversabilityNet, others: dict[str, Score], maps: MappedTerrain, number: int) -> Layers:
    """Return the layers of one map to draw."""
    rating = net(*maps.maps, resolution=maps.resolution, robot=maps.robot)
    everywhere = torch.ones_like(maps.validity)
    shown = {
        _ELEVATION: (maps.elevation, maps.validity),
        "label": (maps.label, maps.rated),
        "learned": (rating.traversability, everywhere),
        "confidence": (rating.confidence, everywhere),
    }
    shown |= {name.replace(" (", "\n("): (score(maps), everywhere) for name, score in others.items()}
    return {name: (values[number], mask[number]) for name, (values, mask) in shown.items()}


def picture(net: TraversabilityNet, others: dict[str, Score], batches: Sequence[MappedTerrain], path: Path) -> None:
    """Draw a row for a map of each pictured kind of ground, or of each kind if none of these is there."""
    rows: dict[str, tuple[MappedTerrain, int]] = {}
    for maps in batches:
        for number, kind in enumerate(maps.kinds):
            rows.setdefault(kind, (maps, number))
    rows = {kind: rows[kind] for kind in PICTURED_KINDS if kind in rows} or rows
    _draw({kind: _layers(net, others, *where) for kind, where in rows.items()}, rows, path)


@styled()
def _draw(rows: dict[str, Layers], sources: dict[str, tuple[MappedTerrain, int]], path: Path) -> None:
    columns = len(next(iter(rows.values())))
    figure = make_figure(1.55 * columns, 1.55 * len(rows) + 1.4)
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (kind, layers) in zip(axes, rows.items(), strict=True):
        images = [_draw_panel(ax, *layer, name) for ax, (name, layer) in zip(line, layers.items(), strict=True)]
        line[0].set_ylabel(f"{kind.replace('_', ' ')}\nrobot {sources[kind][0].robot.length:.2f} m")
    for ax, name in zip(axes[0], next(iter(rows.values())), strict=True):
        ax.set_title(name)
    _draw_color_bars(figure, axes, images)
    write(figure, path)


def _draw_color_bars(figure: Figure, axes: Any, images: list[Any]) -> None:
    """Draw one bar for the elevations, whose limits differ by row, and one for all ratings."""
    heights = figure.colorbar(images[0], ax=axes[:, :1], location="bottom", aspect=8, pad=0.02, ticks=[])
    heights.set_label("[m], low to high")
    figure.colorbar(images[1], ax=axes[:, 1:], location="bottom", aspect=45, pad=0.02).set_label(
        "0: impassable or not confident, 1: traversable or confident; grey: unknown or not rated"
    )


def _draw_panel(ax: Axes, values: Tensor, mask: Tensor, name: str) -> Any:
    limits = {} if name == _ELEVATION else {"vmin": 0.0, "vmax": 1.0}
    shown = np.ma.masked_array(values.double().numpy(), ~mask.numpy())
    ax.set(xticks=[], yticks=[])
    return draw_cells(ax, shown, (0, 1, 0, 1), HEIGHTS if name == _ELEVATION else RATINGS, **limits)


@click.command(help=__doc__)
@click.option(
    "--data", type=click.Path(path_type=Path), default=Path("runs/traversability_experiment/data"), show_default=True,
    help="Folder of the maps; missing ones are made.",
)  # fmt: skip
@click.option("--weights", type=click.Path(path_type=Path, exists=True), help="Default: the shipped ones.")
@paper_weights_option
@click.option("--batches", default=20, show_default=True, help="Held-out batches to choose the first maps from.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "traversability.png", help="File to write.")
def main(data: Path, weights: Path | None, paper_weights: Path | None, batches: int, out: Path) -> None:
    """Draw held-out maps with existing weights."""
    net = TraversabilityNet.from_pretrained(weights) if weights else TraversabilityNet.from_pretrained()
    others = {name: score for name, score in baselines(paper_weights).items() if name in PICTURED_HEADS}
    picture(net, others, data_set(data, "held_out", batches, 0, DataConfig(), KINDS, 0.04), out)


if __name__ == "__main__":
    main()
