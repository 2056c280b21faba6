"""The figure: the maps of the features beside the truth, cropped to where they differ."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from benchmarks.quality.features.comparison import Outcome
from benchmarks.quality.features.reading import GRID, Figures
from torchelev.viz.palette import HEIGHTS, ROBOT_COLOR
from torchelev.viz.style import draw_cells, make_figure, styled, write


class Row(NamedTuple):
    """How a feature is pictured."""

    caption: str  #: what the number of a panel counts
    figure: str  #: the number
    crop: tuple[float, float, float, float]  #: x_min, x_max, y_min, y_max [m]
    layer: str = "elevation"
    outlined: bool = False  #: outline the boxes that are not ground, whose cells the number counts


ROWS = {
    "drift compensation": Row("step at the seam", "seam [cm]", (0.4, 4.4, -3.2, 0.2)),
    "cleanup: person": Row("person left after 1 s", "left after 1 s [%]", (0.6, 4.4, -1.6, 1.6)),
    "exclusion area": Row(
        "too high under the ceiling\n(outlined)", "ceiling at the end [%]", (0.9, 4.4, -1.6, 1.6), outlined=True
    ),
    "edges": Row("error of top cells", "top cells [cm]", (0.9, 3.3, -1.0, 1.0)),
    "overlap clearance: up": Row("cells of the other floor", "other floor [%]", (-3.2, 2.2, -2.4, 2.4)),
    "upper bound": Row("unseen cells bounded", "bounded [%]", (-0.4, 3.8, -2.3, 1.4), "upper_bound"),
}


@styled()
def draw(outcomes: list[Outcome], path: Path) -> None:
    """Draw a row per pictured feature: the truth and the map of each configuration, on one color scale."""
    outcomes = [outcome for outcome in outcomes if outcome.feature.name in ROWS]
    figure = make_figure(9, 2.25 * len(outcomes))
    axes = figure.subplots(len(outcomes), 4, squeeze=False, sharex="row", sharey="row")
    for row, outcome in zip(axes, outcomes, strict=True):
        _draw_row(figure, row, outcome, ROWS[outcome.feature.name])
    for ax in axes[-1]:
        ax.set_xlabel("x [m]")
    write(figure, path)


def _draw_row(figure: Figure, axes: Any, outcome: Outcome, row: Row) -> None:
    """Draw the truth and the maps of one feature."""
    xy = outcome.maps["on"].cell_centers()[0]
    layers = {"truth": outcome.recording.truth(xy)}
    layers |= {name: emap.layer(row.layer)[0].double() for name, emap in outcome.maps.items()}
    low, high = _limits(layers, xy, row.crop)
    for ax, (name, values) in zip(axes, layers.items(), strict=True):
        image = draw_cells(ax, values, _extent(xy), HEIGHTS, vmin=low, vmax=high)
        ax.set(xlim=row.crop[:2], ylim=row.crop[2:], title=_title(name, outcome.figures.get(name), row.figure))
        _draw_objects(ax, outcome, row)
    axes[0].set_ylabel(f"{outcome.feature.name}:\n{row.caption}\ny [m]")
    figure.colorbar(image, ax=list(axes), pad=0.01).set_label(f"{row.layer.replace('_', ' ')} [m]")


def _title(name: str, figures: Figures | None, figure: str) -> str:
    """Return the configuration with its number."""
    unit = figure.rpartition(" [")[2].rstrip("]")
    return f"{name}: {figures[figure]:.1f} {unit}" if figures else name


def _extent(xy: Tensor) -> tuple[float, float, float, float]:
    corner, end = xy[0, 0] - GRID.resolution / 2, xy[-1, -1] + GRID.resolution / 2
    return float(corner[0]), float(end[0]), float(corner[1]), float(end[1])


def _limits(layers: dict[str, Tensor], xy: Tensor, crop: tuple[float, float, float, float]) -> tuple[float, float]:
    """Return the ends of the color scale [m]: those of the truth and of the map in the crop, without outliers."""
    inside = (xy[..., 0] > crop[0]) & (xy[..., 0] < crop[1]) & (xy[..., 1] > crop[2]) & (xy[..., 1] < crop[3])
    known = [layers[name][inside & layers[name].isfinite()] for name in ("truth", "on", "off")]
    low, high = (float(torch.cat(known).quantile(q)) for q in (0.002, 0.998))
    return low - 0.01, max(high, low + 0.1) + 0.01


def _draw_objects(ax: Axes, outcome: Outcome, row: Row) -> None:
    """Draw the robot's path, and the outlines of what hangs over the ground."""
    path = torch.stack([frame.T_map_base[0, :2, 3] for frame in outcome.recording.frames])
    ax.plot(path[:, 0], path[:, 1], color=ROBOT_COLOR, linewidth=1.2)
    for box in outcome.recording.scene.boxes if row.outlined else ():
        if not box.grounded:
            size = box.high[0] - box.low[0], box.high[1] - box.low[1]
            ax.add_patch(Rectangle(box.low[:2], *size, fill=False, edgecolor="black", linestyle="--"))
