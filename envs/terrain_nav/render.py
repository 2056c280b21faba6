"""Pictures of TerrainNav: the ground, the robot's map of it, the robot and its goal. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon

from envs.terrain_nav.config import TerrainNavConfig
from envs.terrain_nav.robot import contacts
from envs.terrain_nav.task import TerrainNav
from torchelev.viz.palette import GOAL_COLOR, HEIGHTS, ROBOT_COLOR
from torchelev.viz.style import draw_cells, make_figure, styled, write

_CONTRAST = 0.6  # [m] above and below the level ground that the colours span
_LOW_COLOR, _HIGH_COLOR = "tab:red", "tab:green"  # of boxes that the robot does not fit under, and of those it does
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
    low: np.ndarray  #: (N, 4, 2) [m] outlines of boxes that the robot does not fit under
    high: np.ndarray  #: (M, 4, 2) [m] outlines of boxes that it fits under


def snapshot(task: TerrainNav, env: int = 0) -> Snapshot:
    """Copy what a picture of one environment shows."""
    cfg, field = task.cfg, task.course.field
    half = (field.heights.shape[1] - 1) / 2 * field.resolution
    emap = getattr(task.sight, "emap", None)
    x, y = (float(v) for v in (emap.center[env, :2] if emap is not None else task.xy[env]))
    radius = cfg.sight.window / 2
    low, high = _outlines(task, env)
    return Snapshot(
        truth=field.heights[task.tile_ids[env]].cpu().numpy(),
        truth_extent=(-half, half, -half, half),
        seen=emap.layer("elevation")[env].cpu().numpy() if emap is not None else None,
        seen_extent=(x - radius, x + radius, y - radius, y + radius),
        footprint=contacts(task.xy, task.yaw, cfg.robot)[env, list(_OUTLINE)].cpu().numpy(),
        xy=task.xy[env].cpu().numpy().copy(),
        goal=task.goal[env].cpu().numpy().copy(),
        seconds=float(task.episode_length[env]) * cfg.dt,
        low=low,
        high=high,
    )


def _outlines(task: TerrainNav, env: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the outlines (N, 4, 2) [m] of the boxes on a robot's tile: those too low for it, and the others."""
    if task.course.structures is None:
        return np.empty((0, 4, 2)), np.empty((0, 4, 2))
    boxes = task.course.structures.boxes(task.tile_ids[env : env + 1])
    T, half = boxes.T_map_box[0], boxes.half_size[0]
    signs = half.new_tensor([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    corners = T[:, None, :2, 3] + (signs * half[:, None, :2]) @ T[:, :2, :2].mT
    ground = task.course.field.height(task.tile_ids[env : env + 1], T[None, :, :2, 3])[0]
    is_low = T[:, 2, 3] - half[:, 2] < ground + task.cfg.robot.top
    is_there = (half > 0).all(-1)
    return corners[is_low & is_there].cpu().numpy(), corners[~is_low & is_there].cpu().numpy()


@styled()
def draw(task: TerrainNav, env: int = 0) -> np.ndarray:
    """Return a picture (h, w, 3) uint8 of one environment: the ground on the left, the map on the right."""
    figure = Figure(figsize=(8, 4), layout="constrained", dpi=80)
    canvas = FigureCanvasAgg(figure)
    shot = snapshot(task, env)
    draw_column(figure.subplots(1, 2), shot, [shot.xy], shot.seen_extent)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@styled()
def save_strip(shots: Sequence[Snapshot], path: Path, *, trail: Sequence[np.ndarray], cfg: TerrainNavConfig) -> None:
    """Write an episode as one picture: a column for each moment, the ground above the map.

    Args:
        shots: The moments.
        path: PNG to write; an SVG is written beside it.
        trail: Positions (2,) [m] of the robot at all steps of the episode.
        cfg: The task.
    """
    figure = make_figure(2.2 * len(shots), 4.4)
    axes = figure.subplots(2, len(shots), sharex=True, sharey=True)
    extent = window_around(np.vstack([np.array(trail), shots[0].goal]))
    for column, shot in zip(axes.T, shots, strict=True):
        walked = trail[: round(shot.seconds / cfg.dt) + 1]
        image = draw_column(column, shot, walked, extent)
    for ax in axes[1]:
        ax.set_xlabel("x [m]")
    for ax, name in zip(axes[:, 0], ("ground", "the robot's map"), strict=True):
        ax.set_ylabel(f"{name}\ny [m]")
    figure.colorbar(image, ax=axes, pad=0.01, extend="both").set_label("height above the level ground [m]")
    write(figure, path)


def window_around(places: np.ndarray, margin: float = 1.2) -> tuple[float, float, float, float]:
    """Return the square (x_min, x_max, y_min, y_max) [m] around places (T, 2) [m], such as a path and its goal."""
    middle, half = (places.max(0) + places.min(0)) / 2, np.ptp(places, axis=0).max() / 2 + margin
    return middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half


def draw_column(
    axes: Sequence[Axes],
    shot: Snapshot,
    walked: Sequence[np.ndarray] | np.ndarray,
    extent: tuple[float, float, float, float],
) -> AxesImage:
    """Draw the ground and the map of one moment, both within `extent` [m], and return the image of the ground."""
    level = float(np.median(shot.truth))
    limits = {"vmin": -_CONTRAST, "vmax": _CONTRAST}
    image = draw_cells(axes[0], shot.truth - level, shot.truth_extent, HEIGHTS, **limits)
    seen = np.full((1, 1), np.nan) if shot.seen is None else shot.seen
    draw_cells(axes[1], seen - level, shot.seen_extent, HEIGHTS, **limits)
    for outlines, color in ((shot.low, _LOW_COLOR), (shot.high, _HIGH_COLOR)):
        for outline in outlines:
            axes[0].add_patch(Polygon(outline, facecolor=color, edgecolor="black", linewidth=0.5, alpha=0.7))
    axes[0].set_title(f"{shot.seconds:.1f} s")
    for ax in axes:
        ax.plot(*np.array(walked).T, color=ROBOT_COLOR)
        ax.add_patch(Polygon(shot.footprint, facecolor="none", edgecolor=ROBOT_COLOR, linewidth=2))
        ax.plot(*shot.goal, marker="*", color=GOAL_COLOR, markeredgecolor="black", markersize=13, clip_on=True)
        ax.set(xlim=extent[:2], ylim=extent[2:])
    return image
