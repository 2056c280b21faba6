"""The picture of a mission: the true terrain, the site map, its error, and the robots' paths."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from torchelev.app.fleet.explore import coarsen
from torchelev.app.fleet.numbers import Comparison, FleetNumbers
from torchelev.viz.relief import draw_relief, rgb
from torchelev.viz.style import ERRORS, HEIGHTS, UNKNOWN_COLOR, draw_cells, make_figure, styled, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAX_ERROR = 5.0  # [cm] of the error's colours
_WIDTH, _HEIGHT = 8.6, 7.6  # [inches]
_OBSTACLE_COLOR = "#8c8c8c"
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
    axes = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    low, high = (float(v) for v in np.percentile(comparison.truth, [1, 99]))
    high = max(high, low + 0.1)
    elevation = comparison.saved.layers["elevation"] - comparison.common_offset
    _draw_heights(figure, axes[0], "ground truth", comparison.truth, comparison, (low, high))
    _draw_heights(figure, axes[1], f"site map of {numbers.robots} robots", elevation, comparison, (low, high))
    _draw_error(figure, axes[2], comparison)
    _draw_paths(axes[3], comparison, tracks)
    _label(axes)
    figure.suptitle(_title(comparison, numbers), fontsize=12)
    write(figure, path)


def _title(comparison: Comparison, numbers: FleetNumbers) -> str:
    x_min, x_max, y_min, y_max = comparison.saved.extent
    return (
        f"{numbers.robots} robots map {x_max - x_min:g} x {y_max - y_min:g} m in {numbers.seconds:.0f} s: "
        f"{100 * numbers.coverage:.1f} % known, RMSE {100 * numbers.rmse_off_steps:.1f} cm away from steps"
    )


def _draw_heights(
    figure: Figure, ax: Axes, title: str, heights: NDArray, comparison: Comparison, limits: tuple[float, float]
) -> None:
    pixels = draw_relief(heights, comparison.saved.resolution, *limits)
    ax.imshow(pixels[::-1], extent=comparison.saved.extent, origin="lower", interpolation="antialiased")
    ax.set_title(title)
    bar = figure.colorbar(ScalarMappable(Normalize(*limits), HEIGHTS), ax=ax, pad=0.02)
    bar.set_label("[m]")


def _draw_error(figure: Figure, ax: Axes, comparison: Comparison) -> None:
    extent, values = comparison.saved.extent, 100 * comparison.error
    image = draw_cells(ax, np.ma.masked_invalid(values), extent, ERRORS, -_MAX_ERROR, _MAX_ERROR)
    ax.set_title("error: site map - ground truth")
    figure.colorbar(image, ax=ax, pad=0.02).set_label("[cm]")


def _draw_paths(ax: Axes, comparison: Comparison, tracks: NDArray) -> None:
    """Draw the robots' paths over what is known: white where robots can walk, dark where it is too steep."""
    elevation, extent = comparison.saved.layers["elevation"], comparison.saved.extent
    area = coarsen(torch.as_tensor(elevation), comparison.saved.resolution)
    blocked = (area.known & ~area.free).numpy()
    count = [n // m for n, m in zip(elevation.shape, blocked.shape, strict=True)]
    pixels = np.full((*elevation.shape, 3), 255, np.uint8)
    pixels[np.kron(blocked, np.ones(count, bool))] = rgb(_OBSTACLE_COLOR)
    pixels[~np.isfinite(elevation)] = rgb(UNKNOWN_COLOR)
    ax.imshow(pixels.swapaxes(0, 1), extent=extent, origin="lower", interpolation="nearest")
    ax.set_title("paths (dark: too steep, light grey: unknown)")
    colors = matplotlib.colormaps[_PATH_COLORS](np.linspace(0.03, 0.97, tracks.shape[1]))
    for track, color in zip(tracks.swapaxes(0, 1), colors, strict=True):
        ax.plot(*track.T, color=color, linewidth=1.3)
        ax.plot(*track[0], "o", color=color, markersize=3)
        ax.plot(*track[-1], "o", color=color, markeredgecolor="black", markersize=6)


def _label(axes: NDArray) -> None:
    for k, ax in enumerate(axes):
        for spine in ax.spines.values():
            spine.set_visible(True)
        if k % 2 == 0:
            ax.set_ylabel("y [m]")
        if k >= 2:
            ax.set_xlabel("x [m]")
