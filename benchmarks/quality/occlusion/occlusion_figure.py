"""The figure: the side view of each scene, and below it the cost from above with the planned path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path as File

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

from benchmarks.quality.occlusion.rules import IMPASSABLE, UPPER_BOUND
from benchmarks.quality.occlusion.scenes import Case
from benchmarks.quality.occlusion.walks import GRID
from torchelev import ElevationMap
from torchelev.planning.planner import Path
from torchelev.planning.traversal_cost import traversal_cost
from torchelev.viz.palette import ROBOT_COLOR
from torchelev.viz.style import draw_cells, make_figure, styled, write

_SPAN = (-1.7, 2.6)  # [m] drawn range of x
EYE = 0.8  # [m] height of the camera
_SHOWN = (UPPER_BOUND, "in-painted by diffusion", "in-painted by the minimum", IMPASSABLE)
Scene = tuple[Case, ElevationMap, float, dict[str, Path]]  # with the robot's x [m] and the path of each rule


@styled()
def draw(out: str | File, scenes: Sequence[Scene]) -> None:
    """Draw a column for each scene: its side view and its cost."""
    figure = make_figure(3 * len(scenes), 6.2)
    axes = figure.subplots(2, len(scenes), sharex=True, squeeze=False, height_ratios=(1.25, 1))
    for column, (case, emap, x, plans) in zip(axes.T, scenes, strict=True):
        _section(column[0], case, emap, x, plans)
        image = _cost(column[1], emap, x, case.goal, plans[UPPER_BOUND])
    figure.colorbar(image, ax=axes[1], pad=0.01, label="cost of each metre [1 on flat ground]")
    axes[0, 0].set_ylabel("z [m]")
    axes[1, 0].set_ylabel("y [m]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    write(figure, out)


def _section(ax: Axes, case: Case, emap: ElevationMap, x: float, plans: dict[str, Path]) -> None:
    """Draw the ground and the map along y = 0, and the decision of each rule."""
    line = np.linspace(*_SPAN, 800)
    truth = case.scene.truth(torch.from_numpy(np.stack([line, 0 * line], -1)))
    middle = GRID.width // 2
    at = emap.cell_centers()[0, :, middle, 0].numpy()
    elevation, bound = (emap.layer(name)[0, :, middle].numpy() for name in ("elevation", "upper_bound"))
    ax.plot(line, truth, color="0.6", linewidth=6, solid_capstyle="butt", label="ground")
    ax.plot(at, np.where(np.isnan(elevation), bound, np.nan), ".", color="C4", markersize=4, label="upper bound")
    ax.plot(at, elevation, ".", color="C0", markersize=4, label="elevation")
    ax.plot(x, EYE, "v", color=ROBOT_COLOR, markersize=9, label="camera")
    ax.plot(case.goal, float(case.scene.truth(torch.tensor([case.goal, 0.0]))), "k*", markersize=9, label="goal")
    ax.set(xlim=_SPAN, ylim=(-1.6, 1.0))
    verdicts = "\n".join(f"{rule}: {'goes' if plans[rule].reached[0] else 'stops'}" for rule in _SHOWN)
    ax.set_title(f"{case.kind}: {'safe' if case.safe else 'a drop'}\n{verdicts}", fontsize=9)


def _cost(ax: Axes, emap: ElevationMap, x: float, goal: float, path: Path) -> AxesImage:
    """Draw the cost and the planned path."""
    xy, half = emap.cell_centers()[0], GRID.resolution / 2
    extent = (
        float(xy[0, 0, 0]) - half,
        float(xy[-1, 0, 0]) + half,
        float(xy[0, 0, 1]) - half,
        float(xy[0, -1, 1]) + half,
    )
    cost = np.ma.masked_invalid(traversal_cost(emap)[0].numpy())
    image = draw_cells(ax, cost, extent, "viridis", vmin=1, vmax=4)
    if path.reached[0]:
        ax.plot(*path.xy[0].T, color="white", linewidth=2)
    ax.plot(x, 0, "v", color=ROBOT_COLOR, markersize=8)
    ax.plot(goal, 0, "k*", markersize=9)
    ax.set(xlim=_SPAN, ylim=(-1.3, 1.3), xlabel="x [m]; grey: impassable", aspect="auto")
    return image
