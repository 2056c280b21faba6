"""The picture of the demo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from torchelev.app.demo.course import LANDMARKS
from torchelev.app.demo.walk import GRID
from torchelev.elevation_map import ElevationMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from torchelev.viz.plot import Panel


def draw(out: str | Path, emap: ElevationMap, truth: Tensor, path_xy: Tensor, title: str) -> None:
    """Write the picture: ground truth, elevation, error, deviation, traversability and upper bound.

    Args:
        out: the file.
        emap: the map.
        truth: (H, W) [m] heights of its cells.
        path_xy: (K, 2) [m] of the robot.
        title: of the picture.
    """
    from torchelev.viz.plot import draw_layers
    from torchelev.viz.style import write

    xy = emap.cell_centers()[0]
    low, high = xy[0, 0] - GRID.resolution / 2, xy[-1, -1] + GRID.resolution / 2
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    figure = draw_layers(_make_panels(emap, truth), extent=extent, path_xy=path_xy.numpy(), title=title)
    _label_landmarks(figure.axes[0])
    write(figure, out)


def _label_landmarks(ax: Axes) -> None:
    box = {"boxstyle": "round,pad=0.15", "facecolor": "black", "alpha": 0.55, "linewidth": 0}
    for name, x, y in LANDMARKS:
        ax.text(x, y, name, color="white", fontsize=8, ha="center", va="center", bbox=box)


def _make_panels(emap: ElevationMap, truth: Tensor) -> list[Panel]:
    """Return the panels of the picture; heights share one colour scale."""
    from torchelev.viz.palette import DEVIATIONS, ERRORS, RATINGS
    from torchelev.viz.plot import Panel

    layers = {name: emap.layer(name)[0].double() for name in ("elevation", "variance", "traversability", "upper_bound")}
    deviation = (1e3 * layers["variance"].sqrt()).numpy()
    error = (100 * (layers["elevation"] - truth)).numpy()
    traversability = layers["traversability"].numpy()
    low, high = float(truth.min()), float(truth.max())

    def show_heights(title: str, values: Tensor) -> Panel:
        return Panel(title=title, values=values.numpy(), unit="m", vmin=low, vmax=high)

    return [
        show_heights("ground truth and the robot's path", truth),
        show_heights("elevation (grey: unknown)", layers["elevation"]),
        Panel(title="error: elevation - ground truth", values=error, unit="cm", cmap=ERRORS, vmin=-5.0, vmax=5.0),
        Panel(title="standard deviation", values=deviation, unit="mm", cmap=DEVIATIONS, vmin=0.0, vmax=50.0),
        Panel(title="traversability", values=traversability, unit="0: impassable, 1: flat", cmap=RATINGS,
              vmin=0.0, vmax=1.0),
        show_heights("upper bound of unseen ground", layers["upper_bound"]),
    ]  # fmt: skip
