"""The gallery's maps of longer drives: a fleet's, a recorded bag's and a real scan's."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from docs.figures.gallery_scenes import read
from docs.figures.surfaces import map_scan
from docs.figures.view import View
from torchelev.app.demo import DemoWalk
from torchelev.app.fleet.mission import Mission
from torchelev.app.fleet.request import FleetRequest
from torchelev.io.export import SavedMap, load_npz
from torchelev.io.poses import read_poses
from torchelev.viz.palette import RATINGS

_ROOT = Path(__file__).parents[2]


def draw_fleet(out: Path) -> None:
    """Draw the site map of `torchelev fleet`, with the paths of its robots."""
    mission = Mission(FleetRequest(), None)
    while not mission.is_done:
        mission.step()
    mission.finish()
    assert mission.saved is not None
    saved, tracks = mission.saved, np.array(mission.robots.tracks)
    heights = saved.layers["elevation"]
    view = View((-24.0, -68.0, 46.0), (-0.8, -6.2, 0.0), 34.0)
    view.add_map(grid_of(heights, saved.extent, saved.resolution), heights)
    colors = matplotlib.colormaps["turbo"](np.linspace(0.03, 0.97, tracks.shape[1]))[:, :3]
    for track, color in zip(tracks.swapaxes(0, 1), colors, strict=True):
        i, j, _ = saved.find_cells(track)
        places = np.column_stack([track, np.nan_to_num(heights[i, j]) + 0.35])
        view.add_path(places, color, radius=0.13)
        view.add_solid(pv.Sphere(radius=0.6, center=places[-1]), color)
    view.save(out)


def draw_bag(out: Path) -> None:
    """Draw the map of a bag, which the demo records."""
    with tempfile.TemporaryDirectory() as folder:
        bag, made = f"{folder}/drive.mcap", f"{folder}/map.npz"
        for command in (["demo", "--record", bag], ["map", bag, "--resolution", "0.05", "--size", "12", "--out", made]):
            subprocess.run([sys.executable, "-m", "torchelev", *command], check=True, cwd=_ROOT)
        draw_drive(load_npz(made), out)


def draw_drive(saved: SavedMap, out: Path) -> None:
    """Draw the map of the demo's walk in the colours of its traversability, with the robot's path."""
    heights, path = saved.layers["elevation"], DemoWalk().path.T_map_base[:, :3, 3].numpy()
    xy = grid_of(heights, saved.extent, saved.resolution)
    is_near = (np.abs(xy) < [4.4, 3.9]).all(-1)
    view = View((-7.2, -8.2, 6.8), (0.1, -0.5, -0.4))
    view.add_map(xy, np.where(is_near, heights, np.nan), saved.layers["traversability"], cmap=RATINGS, clim=(0.0, 1.0))
    view.add_path(path, radius=0.035)
    view.save(out)


def grid_of(values: NDArray, extent: tuple[float, float, float, float], resolution: float) -> NDArray:
    """Return the centres (H, W, 2) [m] of the cells of a saved map."""
    x, y = (start + resolution * (np.arange(n) + 0.5) for start, n in zip(extent[::2], values.shape, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1)


def draw_real_scan(recording: Path, out: Path) -> None:
    """Draw the map of one lidar scan off road, and the path that the robot drove afterwards."""
    scan, pose = min((recording / "scans").glob("*.bin")), read_poses(recording / "poses.txt").T_map_sensor[0]
    xy, elevation = read(map_scan(scan, pose))
    middle = float(np.nanmedian(elevation))
    driven = read_poses(recording / "driven_path.txt").T_map_sensor[:, :3, 3]
    x, y = xy.mean((0, 1))
    view = View((x + 3.5, y - 8.3, 5.2), (x, y + 0.2, 0.2))
    view.add_map(xy, elevation - middle)
    view.add_path(driven - [0.0, 0.0, middle], radius=0.04)
    view.save(out)
