"""Pictures of TerrainNav: the ground, the robot's map of it, the robot and its goal. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from envs.terrain_nav.config import BodyConfig, TerrainNavConfig
from envs.terrain_nav.robot import contacts
from envs.terrain_nav.task import TerrainNav
from torchelev.viz.plot import UNKNOWN_COLOR

_OUTLINE = (0, 1, 3, 2)  # indices of the footprint's corners in `contacts`, counted around it


class Snapshot(NamedTuple):
    """One environment at one moment, as arrays."""

    truth: np.ndarray  #: (H, W) [m] height of the ground
    truth_extent: tuple[float, float, float, float]  #: [m] x_min, x_max, y_min, y_max of the ground
    seen: np.ndarray | None  #: (H, W) [m] elevation of the map, NaN where unknown; None without a map
    seen_extent: tuple[float, float, float, float]  #: [m] x_min, x_max, y_min, y_max of the map
    footprint: np.ndarray  #: (4, 2) [m] corners of the robot
    xy: np.ndarray  #: (2,) [m] position of the robot
    goal: np.ndarray  #: (2,) [m]
    seconds: float  #: [s] since the episode began


def snapshot(task: TerrainNav, env: int = 0) -> Snapshot:
    """Copy what a picture of one environment shows."""
    cfg, field = task.cfg, task.course.field
    half = (field.heights.shape[1] - 1) / 2 * field.resolution
    emap = getattr(task.sight, "emap", None)
    x, y = (float(v) for v in (emap.center[env, :2] if emap is not None else task.xy[env]))
    radius = cfg.sight.window / 2
    return Snapshot(
        truth=field.heights[task.tile_ids[env]].cpu().numpy(),
        truth_extent=(-half, half, -half, half),
        seen=emap.layer("elevation")[env].cpu().numpy() if emap is not None else None,
        seen_extent=(x - radius, x + radius, y - radius, y + radius),
        footprint=contacts(task.xy, task.yaw, cfg.robot)[env, list(_OUTLINE)].cpu().numpy(),
        xy=task.xy[env].cpu().numpy().copy(),
        goal=task.goal[env].cpu().numpy().copy(),
        seconds=float(task.episode_length[env]) * cfg.dt,
    )


def draw(task: TerrainNav, env: int = 0) -> np.ndarray:
    """Return a picture (h, w, 3) uint8 of one environment: the ground on the left, the map on the right."""
    figure = Figure(figsize=(8, 4), layout="compressed", dpi=80)
    canvas = FigureCanvasAgg(figure)
    shot = snapshot(task, env)
    _draw_column(figure.subplots(1, 2), shot, [shot.xy], task.cfg.robot)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_strip(shots: Sequence[Snapshot], path: Path, *, trail: Sequence[np.ndarray], cfg: TerrainNavConfig) -> None:
    """Write an episode as one picture: a column for each moment, the ground above the map.

    Args:
        shots: The moments.
        path: File to write; its suffix decides on the format.
        trail: Positions (2,) [m] of the robot at all steps of the episode.
        cfg: The task.
    """
    figure = Figure(figsize=(3 * len(shots), 6), layout="compressed", dpi=80)
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(shots))
    for column, shot in zip(axes.T, shots, strict=True):
        walked = trail[: round(shot.seconds / cfg.dt) + 1]
        _draw_column(column, shot, walked, cfg.robot)
    figure.savefig(path)


def _draw_column(axes: Sequence[Axes], shot: Snapshot, walked: Sequence[np.ndarray], robot: BodyConfig) -> None:
    level = float(np.median(shot.truth))
    _draw_heights(axes[0], shot.truth, shot.truth_extent, level)
    axes[0].set_title(f"ground, {shot.seconds:.1f} s", fontsize=9)
    seen = np.full((1, 1), np.nan) if shot.seen is None else shot.seen
    _draw_heights(axes[1], seen, shot.seen_extent, level)
    axes[1].set_title("the robot's map" if shot.seen is not None else "no map", fontsize=9)
    for ax in axes:
        ax.plot(*np.array(walked).T, color="tab:red", linewidth=1)
        ax.add_patch(Polygon(shot.footprint, facecolor="none", edgecolor="tab:red", linewidth=1.5))
        ax.plot(*shot.goal, marker="*", color="tab:orange", markersize=12, clip_on=True)
        ax.tick_params(labelsize=7)
    axes[1].set_xlim(shot.seen_extent[:2])
    axes[1].set_ylim(shot.seen_extent[2:])


def _draw_heights(ax: Axes, heights: np.ndarray, extent: tuple[float, float, float, float], level: float) -> None:
    """Draw heights (H, W) [m], with colours for 0.6 m below to 0.6 m above `level` [m]."""
    ax.set_facecolor(UNKNOWN_COLOR)
    low, high = level - 0.6, level + 0.6
    image = heights.T
    ax.imshow(image, cmap="terrain", vmin=low, vmax=high, origin="lower", extent=extent, interpolation="nearest")
