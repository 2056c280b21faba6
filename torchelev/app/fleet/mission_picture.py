"""The picture of a mission: the true terrain, the site map, its error, and the robots' paths."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from numpy.typing import NDArray

from torchelev.app.fleet.numbers import Comparison, FleetNumbers, count_robots
from torchelev.viz.palette import ERRORS, HEIGHTS, UNKNOWN_COLOR
from torchelev.viz.relief import draw_relief
from torchelev.viz.style import draw_cells, make_figure, styled, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from torchelev.io.export import SavedMap

_MAX_ERROR = 5.0  # [cm] of the error's colours
_WIDTH, _HEIGHT = 8.6, 7.6  # [inches]
_PATH_COLORS = "turbo"


@styled()
def draw_fleet(path: str | Path, comparison: Comparison, tracks: NDArray, numbers: FleetNumbers) -> None:
    """Write the picture.

    Args:
        path: of the file.
        comparison: of the site map with the truth.
        tracks: (T, B, 2) [m] the robots' places.
        numbers: for the title.
    """
    figure = make_figure(_WIDTH, _HEIGHT)
    figure.set_layout_engine("compressed")
    (truth, site), (paths, error) = figure.subplots(2, 2, sharex=True, sharey=True)
    _draw_heights(figure, truth, site, comparison, numbers)
    _draw_paths(paths, comparison.saved, tracks)
    _draw_error(figure, paths, error, comparison)
    _label(truth, site, paths, error)
    figure.suptitle(_title(comparison, numbers), fontsize=12)
    write(figure, path)


def _title(comparison: Comparison, numbers: FleetNumbers) -> str:
    x_min, x_max, y_min, y_max = comparison.saved.extent
    return (
        f"{count_robots(numbers.robots)}, {x_max - x_min:g} x {y_max - y_min:g} m, {numbers.seconds:.0f} s: "
        f"{100 * numbers.coverage:.1f} % known, RMSE {100 * numbers.rmse_off_steps:.1f} cm away from steps"
    )


def _draw_heights(figure: Figure, truth: Axes, site: Axes, comparison: Comparison, numbers: FleetNumbers) -> None:
    """Draw both heights with the same colours."""
    saved = comparison.saved
    low, high = (float(v) for v in np.percentile(comparison.truth, [1, 99]))
    high = max(high, low + 0.1)
    elevation = saved.layers["elevation"] - comparison.common_offset
    panels = {
        "ground truth": (truth, comparison.truth),
        f"site map of {count_robots(numbers.robots)}": (site, elevation),
    }
    for title, (ax, heights) in panels.items():
        pixels = draw_relief(heights, saved.resolution, low, high)
        ax.imshow(pixels[::-1], extent=saved.extent, origin="lower", interpolation="antialiased")
        ax.set_title(title)
    bar = figure.colorbar(ScalarMappable(Normalize(low, high), HEIGHTS), ax=[truth, site], pad=0.02, aspect=30)
    bar.set_label("[m]")


def _draw_error(figure: Figure, beside: Axes, ax: Axes, comparison: Comparison) -> None:
    values = np.ma.masked_invalid(100 * comparison.error)
    image = draw_cells(ax, values, comparison.saved.extent, ERRORS, -_MAX_ERROR, _MAX_ERROR)
    ax.set_title("error: site map - ground truth")
    figure.colorbar(image, ax=[beside, ax], pad=0.02, aspect=30).set_label("[cm]")


def _draw_paths(ax: Axes, saved: SavedMap, tracks: NDArray) -> None:
    """Draw the robots' paths over the known ground, lit from the upper left; a large dot ends a path."""
    shade = LightSource(315, 45).hillshade(saved.layers["elevation"].T[::-1], dx=saved.resolution, dy=saved.resolution)
    ax.set_facecolor(UNKNOWN_COLOR)
    ax.imshow(shade[::-1], extent=saved.extent, origin="lower", cmap="gray", vmin=-1.0, vmax=0.75)
    ax.set_title("paths of the robots (grey: unknown)")
    colors = matplotlib.colormaps[_PATH_COLORS](np.linspace(0.03, 0.97, tracks.shape[1]))
    for track, color in zip(tracks.swapaxes(0, 1), colors, strict=True):
        ax.plot(*track.T, color=color, linewidth=1.3)
        ax.plot(*track[0], "o", color=color, markersize=3)
        ax.plot(*track[-1], "o", color=color, markeredgecolor="black", markersize=6)


def _label(*axes: Axes) -> None:
    for k, ax in enumerate(axes):
        for spine in ax.spines.values():
            spine.set_visible(True)
        if k % 2 == 0:
            ax.set_ylabel("y [m]")
        if k >= 2:
            ax.set_xlabel("x [m]")
