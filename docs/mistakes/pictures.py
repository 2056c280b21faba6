"""A picture of a mistake: the right map beside the wrong one."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from docs.mistakes.cases import Case
from torchelev import ElevationMap
from torchelev.viz.palette import HEIGHTS
from torchelev.viz.style import draw_cells, make_figure


def draw(case: Case, right: ElevationMap, wrong: ElevationMap) -> Figure:
    """Draw the elevation of two maps side by side, with the colours of the right one."""
    figure = make_figure(6.6, 2.9)
    axes = figure.subplots(1, 2)
    heights, others = (emap.layer("elevation")[0].numpy() for emap in (right, wrong))
    low, high = np.nanpercentile(heights, [1, 99])
    limits = low, max(high, low + 0.3)
    image = _draw_map(axes[0], right, heights, limits)
    _draw_map(axes[1], wrong, others.T if case.drawn_wrong else others, limits)
    nothing = "" if np.isfinite(others).any() else ": nothing is known"
    axes[0].set(title="as it should be", ylabel="y [m]")
    axes[1].set(title=f"with the mistake{nothing}")
    figure.colorbar(image, ax=axes, pad=0.01).set_label("elevation [m]")
    return figure


def _draw_map(ax: Axes, emap: ElevationMap, heights: NDArray, limits: tuple[float, float]) -> AxesImage:
    """Draw heights (H, W) where the map lies, x to the right and y up; unknown cells are grey."""
    grid, (x, y, _) = emap.cfg.grid, emap.center[0].tolist()
    half_x, half_y = grid.length_x / 2, grid.length_y / 2
    ax.title.set_fontsize(10)
    ax.set_xlabel("x [m]")
    extent = (x - half_x, x + half_x, y - half_y, y + half_y)
    return draw_cells(ax, heights, extent, HEIGHTS, vmin=limits[0], vmax=limits[1])
