"""The gallery's maps of simulated scenes; `docs.figures.gallery` names them."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pyvista as pv
import torch
from matplotlib.colors import ListedColormap
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from docs.figures.levels import LIDAR
from docs.figures.view import SIZE, View, save_cut_out
from docs.moving_picture import batch
from docs.moving_picture.stage import Stage
from docs.moving_picture.walk import Path as RobotPath
from docs.moving_picture.walk import make_ground, walk
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LevelsConfig
from torchelev.sim.exact.covered_scenes import bridge
from torchelev.sim.poses import pose
from torchelev.viz.palette import ROBOT_COLOR, UNKNOWN_COLOR

_ROOT = Path(__file__).parents[2]
_ARROW = 0.9 * np.array([[0.36, 0.0], [-0.26, 0.22], [-0.14, 0.0], [-0.26, -0.22]])  # [m] a robot from above


def read(emap: ElevationMap, level: int | None = None) -> tuple[NDArray, NDArray]:
    """Return the centres (H, W, 2) [m] of the first map's cells, and the heights (H, W) [m] of one of its surfaces."""
    return emap.cell_centers()[0].numpy(), emap.layer("elevation", level=level)[0].numpy()


def draw_stairs(out: Path) -> None:
    """Draw a quadruped on stairs, its map, and the view of its camera."""
    path = RobotPath(make_ground())
    *_, moment = walk(path, 10, 3.2)
    stage = Stage(path, SIZE)
    stage.plotter.camera_position = [(-2.7, -4.9, 2.8), (-0.5, 0.1, 0.5), (0, 0, 1)]
    stage.render(moment)
    save_cut_out(stage.plotter, out)


def draw_batch(out: Path) -> None:
    """Draw sixteen maps that are updated by one call, each at its place in the grid of tiles."""
    *_, (elevation, yaw) = batch.walk_in_circles(batch.make_tiles(), 110, 10)
    view = View((0.0, -27.0, 24.0), (0.0, -0.9, 0.0), 30.0)
    axis = (np.arange(96) - 47.5) * batch.GRID.resolution
    centers = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    for k, (heights, heading) in enumerate(zip(elevation, yaw, strict=True)):
        middle = 5.6 * (np.array(divmod(k, 4)[::-1]) - 1.5)
        view.add_map(centers + middle, heights, clim=(-1.0, 0.9))
        ground = float(np.nanmax(heights[44:52, 44:52])) if np.isfinite(heights[44:52, 44:52]).any() else 0.0
        view.add_solid(arrow(middle, float(heading), ground + 0.3), ROBOT_COLOR)
    view.save(out)


def arrow(middle: NDArray, heading: float, z: float, scale: float = 1.0) -> pv.PolyData:
    """Return an arrow head that stands for a robot, 12 cm thick."""
    cos, sin = np.cos(heading), np.sin(heading)
    corners = scale * _ARROW @ np.array([[cos, sin], [-sin, cos]]) + middle
    flat = pv.PolyData(np.column_stack([corners, np.full(4, z)]), faces=[3, 0, 1, 2, 3, 0, 2, 3])
    return flat.extrude((0.0, 0.0, 0.12 * scale), capping=True)


def draw_ceilings(out: Path) -> None:
    """Draw all surfaces of the map of a robot that walked under a bridge, then over it."""
    scene, grid = bridge(8), GridConfig(resolution=0.05, length_x=18.0, length_y=14.0)
    emap = ElevationMap(ElevationMapConfig(grid=grid, levels=LevelsConfig()))
    road = [(0.0, y, 0.0) for y in np.arange(-3.6, 3.0, 0.12)]
    x = np.arange(-4.6, 4.6, 0.12)
    heights = scene.truth(torch.from_numpy(np.column_stack([x, 0.0 * x]))).numpy()
    for place in [*road, *zip(x, 0.0 * x, heights, strict=True)]:
        T_map_base = pose(torch.tensor(place, dtype=torch.float64) + torch.tensor([0.0, 0.0, 0.5]), 0.0)
        emap.update(LIDAR.cast(scene, T_map_base)[None], T_map_base[None], T_map_base[None], dt=0.2)
    view = View((5.2, -9.3, 5.1), (0.25, 0.0, -0.25))
    over = np.column_stack([x, 0.0 * x, gaussian_filter1d(heights, 3.0)])
    for path in (np.array(road), over):
        view.add_path(path + [0.0, 0.0, 0.25], radius=0.035)
    xy = emap.cell_centers()[0].numpy()
    is_near = (np.abs(xy) < [5.0, 2.9]).all(-1)
    for level in range(2):
        _, surface = read(emap, level=level)
        view.add_map(xy, np.where(is_near, surface, np.nan), clim=(-0.7, 1.5))
    view.save(out)


def draw_classes(out: Path) -> None:
    """Draw the map of examples/ground_classes.py in the colours of the most probable classes."""
    with mock.patch.object(sys, "argv", ["ground_classes.py"]):
        made = runpy.run_path(str(_ROOT / "examples" / "ground_classes.py"), run_name="__main__")
    emap, colors = made["emap"], made["COLORS"]
    xy, heights = read(emap)
    probabilities = emap.layer("terrain")[0].numpy()
    is_block, is_known = heights > 0.1, np.isfinite(probabilities).all(0)
    best = np.where(is_block, np.nan, probabilities.argmax(0))
    view = View((2.2, -6.4, 4.4), (2.4, 0.0, 0.0))
    style = {"cmap": ListedColormap([*colors.values()]), "clim": (-0.5, len(colors) - 0.5), "nan_color": UNKNOWN_COLOR}
    view.add_map(xy, np.where(is_block | is_known, heights, np.nan), best, **style)
    view.save(out)
