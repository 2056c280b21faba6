"""The figure: the last maps of the features, beside the truth."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import torch

from benchmarks.quality.features.comparison import Outcome
from benchmarks.quality.features.reading import GRID, Figures
from benchmarks.quality.features.visibility import bounds

PICTURED = (
    "drift compensation", "cleanup: person", "exclusion area", "edges", "overlap clearance: up", "upper bound",
)  # fmt: skip


def draw(outcomes: list[Outcome], path: Path) -> None:
    """Draw a row per pictured feature: the truth and the last map of each configuration, on one color scale."""
    from matplotlib.figure import Figure

    outcomes = [outcome for outcome in outcomes if outcome.feature.name in PICTURED]
    figure = Figure(figsize=(12.5, 2.15 * len(outcomes)), layout="compressed")
    axes = figure.subplots(len(outcomes), 4, squeeze=False)
    for row, outcome in zip(axes, outcomes, strict=True):
        _draw_row(figure, row, outcome)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]")
    figure.savefig(path, dpi=80)


def _limits(*layers: torch.Tensor) -> tuple[float, float]:
    """Return the ends of the color scale [m], beyond which at most 1 in 1000 cells of a layer lies at either end."""
    known = [layer[layer.isfinite()] for layer in layers]
    return min(float(z.quantile(0.001)) for z in known) - 0.02, max(float(z.quantile(0.999)) for z in known) + 0.02


def _title(figures: Figures, shown: tuple[str, ...]) -> str:
    """Return a short text of some figures."""
    parts = [(figures[metric], *metric.rstrip("]").partition(" [")) for metric in shown]
    return ", ".join(f"{name.removesuffix(' at the end')} {value:.1f} {unit}" for value, name, _, unit in parts)


def _draw_row(figure: Any, row: Any, outcome: Outcome) -> None:
    """Draw the truth and the maps of one feature."""
    xy = outcome.maps["on"].cell_centers()[0]
    truth = outcome.recording.truth(xy)
    layer = "upper_bound" if outcome.feature.measure is bounds else "elevation"
    low, high = _limits(truth, outcome.maps["on"].layer("elevation")[0].double())
    layers = {"truth": truth, **{name: emap.layer(layer)[0] for name, emap in outcome.maps.items()}}
    corner, end = xy[0, 0] - GRID.resolution / 2, xy[-1, -1] + GRID.resolution / 2
    extent = (float(corner[0]), float(end[0]), float(corner[1]), float(end[1]))
    path = torch.stack([frame.T_map_base[0, :2, 3] for frame in outcome.recording.frames])
    shown = (next(iter(outcome.feature.bars)), *outcome.feature.shown)
    for ax, (name, values) in zip(row, layers.items(), strict=True):
        image = ax.imshow(values.T, origin="lower", extent=extent, vmin=low, vmax=high, interpolation="nearest")
        ax.set_facecolor("#d9d9d9")
        ax.plot(path[:, 0], path[:, 1], color="crimson", linewidth=0.8)
        ax.set(xlim=(-4, 4.5), ylim=(-3.2, 3.2))
        figures = outcome.figures.get(name)
        title = f"{name}: {_title(figures, shown)}" if figures else name
        ax.set_title(textwrap.fill(title, 32), fontsize=9)
    row[0].set_ylabel(f"{outcome.feature.name}\ny [m]", fontsize=9)
    figure.colorbar(image, ax=list(row), pad=0.01).set_label(f"{layer.replace('_', ' ')} [m]", fontsize=8)
