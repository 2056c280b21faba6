"""A figure of maps, their labels and the ratings of the heads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchelev.traversability.net import TraversabilityNet
from torchelev.viz.plot import UNKNOWN_COLOR
from training.traversability.heads import Score
from training.traversability.maps.data import MappedTerrain

Layers = dict[str, tuple[Tensor, Tensor]]  # values and mask of the cells to show, (H, W) each


@torch.no_grad()
def _layers(net: TraversabilityNet, others: dict[str, Score], maps: MappedTerrain, number: int) -> Layers:
    """Return the layers of one map to draw."""
    rating = net(*maps.maps, resolution=maps.resolution, robot=maps.robot)
    everywhere = torch.ones_like(maps.validity)
    shown = {
        "elevation [m]": (maps.elevation, maps.validity),
        "label": (maps.label, maps.rated),
        "learned": (rating.traversability, everywhere),
        "confidence": (rating.confidence, everywhere),
    }
    shown |= {name: (score(maps), everywhere) for name, score in others.items()}
    return {name: (values[number], mask[number]) for name, (values, mask) in shown.items()}


def picture(net: TraversabilityNet, others: dict[str, Score], batches: Sequence[MappedTerrain], path: Path) -> None:
    """Draw a row for one map of each kind of ground, x to the right and y up; gray is unknown or not rated."""
    rows: dict[str, tuple[MappedTerrain, int]] = {}
    for maps in batches:
        for number, kind in enumerate(maps.kinds):
            rows.setdefault(kind, (maps, number))
    _draw({kind: _layers(net, others, *where) for kind, where in rows.items()}, rows, path)


def _draw(rows: dict[str, Layers], sources: dict[str, tuple[MappedTerrain, int]], path: Path) -> None:
    from matplotlib.figure import Figure

    columns = len(next(iter(rows.values())))
    figure = Figure(figsize=(1.9 * columns, 2.0 * len(rows)), layout="compressed", dpi=80)
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (kind, layers) in zip(axes, rows.items(), strict=True):
        maps = sources[kind][0]
        for ax, (name, layer) in zip(line, layers.items(), strict=True):
            _panel(ax, *layer, is_rating=name != "elevation [m]")
        line[0].set_ylabel(f"{kind}\n{100 * maps.resolution:.2g} cm, robot {maps.robot.length:.2f} m", fontsize=7)
    for ax, name in zip(axes[0], next(iter(rows.values())), strict=True):
        ax.set_title(name, fontsize=8)
    figure.savefig(path)


def _panel(ax: Any, values: Tensor, mask: Tensor, is_rating: bool) -> None:
    shown = np.ma.masked_array(values.double().numpy(), ~mask.numpy()).T
    limits = {"vmin": 0.0, "vmax": 1.0, "cmap": "RdYlGn"} if is_rating else {"cmap": "viridis"}
    ax.imshow(shown, origin="lower", interpolation="nearest", **limits)
    ax.set(xticks=[], yticks=[], facecolor=UNKNOWN_COLOR)
