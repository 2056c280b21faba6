"""Maps as lit 3D surfaces, coloured by height or by standard deviation.

    python -m docs.figures.surfaces uncertainty
    python -m docs.figures.surfaces real_scan SCANS POSES      # KITTI layout: a folder of .bin files, and poses.txt

Writes docs/pictures/uncertainty.png or real_scan.png. Needs pyvista (``pip install pyvista``).
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
import pyvista as pv
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from docs.moving_picture.stage import add_lights
from docs.moving_picture.surface import surface
from docs.moving_picture.walk import GRID, make_ground, walk
from docs.moving_picture.walk import Path as RobotPath
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.io.poses import read_poses
from torchelev.viz.palette import DEVIATIONS, HEIGHTS
from torchelev.viz.style import draw_cells, make_figure, styled, write

PICTURES = Path(__file__).parents[1] / "pictures"
_SIZE = (1500, 900)  # [pixels]
REAL_GRID = GridConfig(resolution=0.1, length_x=10.0, length_y=10.0)
SENSOR_HEIGHT = 0.48  # [m] of the lidar over the ground, to which the window is centred
Camera = tuple[tuple[float, float, float], tuple[float, float, float]]  # position and focus [m]


def render(mesh: pv.PolyData, cmap: str, limits: tuple[float, float], camera: Camera) -> NDArray:
    """Return a picture (h, w, 3) of a surface, lit from the left, on white."""
    plotter = pv.Plotter(off_screen=True, window_size=[2 * length for length in _SIZE], lighting="none")
    plotter.set_background("white")
    add_lights(plotter)
    plotter.add_mesh(mesh, scalars="values", cmap=cmap, clim=limits, show_scalar_bar=False, ambient=0.35)
    plotter.camera_position = [*camera, (0, 0, 1)]
    plotter.camera.view_angle = 34
    picture = np.asarray(plotter.screenshot(return_img=True))[..., :3].astype(float)
    plotter.close()
    return picture.reshape(_SIZE[1], 2, _SIZE[0], 2, 3).mean((1, 3)) / 255


def _add_surface(ax: Axes, picture: NDArray, cmap: str, limits: tuple[float, float], label: str) -> None:
    """Show a rendered surface with its colour bar."""
    ax.imshow(picture, origin="upper", interpolation="antialiased")
    ax.axis("off")
    colors = ScalarMappable(Normalize(*limits), cmap)
    ax.figure.colorbar(colors, ax=ax, shrink=0.75, pad=0.01, extend="max").set_label(label)


@styled()
def draw_uncertainty(out: Path, seconds: float = 6.4) -> None:
    """Draw the map of the moving picture's walk after some seconds, coloured by its standard deviation."""
    *_, moment = walk(RobotPath(make_ground()), 5, seconds)
    deviation = 1e3 * np.sqrt(moment.variance)
    mesh = surface(moment.xy, moment.elevation, GRID.resolution, deviation)
    limits = 0.0, 30.0
    figure = make_figure(8, 4.4)
    picture = render(mesh, DEVIATIONS, limits, ((1.6, -6.6, 5.6), (0.2, 0.0, 0.0)))
    _add_surface(figure.subplots(), picture, DEVIATIONS, limits, "standard deviation [mm]")
    write(figure, out)


@styled()
def draw_real_scan(scan: Path, pose: NDArray, driven: NDArray | None, out: Path) -> None:
    """Draw one lidar scan's map as a surface and from above, with the path that the robot drove, if known.

    Args:
        scan: float32 file of x, y, z and intensity [m].
        pose: (4, 4) T_map_sensor.
        driven: (T, 3) [m] positions of the sensor, map frame.
        out: PNG to write.
    """
    emap = map_scan(scan, pose)
    xy, elevation = emap.cell_centers()[0].numpy(), emap.layer("elevation")[0].numpy()
    middle = np.nanmedian(elevation)
    heights = elevation - middle
    low, high = (float(v) for v in np.nanpercentile(heights, [2, 98]))
    figure = make_figure(9, 3.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.45, 1))
    x, y = xy.mean((0, 1))
    camera = ((x + 3.5, y - 8.3, 6.0), (x, y - 0.2, 0.0))
    picture = render(surface(xy, heights, REAL_GRID.resolution), HEIGHTS, (low, high), camera)
    left.imshow(picture, origin="upper", interpolation="antialiased")
    left.axis("off")
    half = REAL_GRID.resolution / 2
    extent = (xy[0, 0, 0] - half, xy[-1, -1, 0] + half, xy[0, 0, 1] - half, xy[-1, -1, 1] + half)
    image = draw_cells(right, heights, extent, HEIGHTS, vmin=low, vmax=high)
    if driven is not None:
        right.plot(*driven[:, :2].T, color="white", linewidth=3.5)
        right.plot(*driven[:, :2].T, color="C1", label="driven path")
        figure.legend(loc="outside lower right")
    right.set(xlabel="x [m]", ylabel="y [m]", xlim=extent[:2], ylim=extent[2:])
    figure.colorbar(image, ax=right, pad=0.02, extend="both").set_label("height over the median [m]")
    write(figure, out)


def map_scan(scan: Path, pose: NDArray) -> ElevationMap:
    """Map one scan around its sensor."""
    points = torch.from_numpy(np.fromfile(scan, np.float32).reshape(-1, 4)[:, :3].copy())
    emap = ElevationMap(ElevationMapConfig(grid=REAL_GRID))
    base = np.eye(4)
    base[:3, 3] = pose[:3, 3] - [0.0, 0.0, SENSOR_HEIGHT]
    emap.update(points[None], torch.from_numpy(pose)[None], torch.from_numpy(base)[None], dt=0.0)
    return emap


@click.group(help=__doc__)
def main() -> None:
    """Draw a surface."""


@main.command()
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES / "uncertainty.png")
def uncertainty(out: Path) -> None:
    """Draw a simulated map coloured by its standard deviation."""
    draw_uncertainty(out)


@main.command("real_scan")
@click.argument("scans", type=click.Path(path_type=Path, exists=True))
@click.argument("poses", type=click.Path(path_type=Path, exists=True))
@click.option("--driven", type=click.Path(path_type=Path, exists=True), help="Poses that the robot drove afterwards.")
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES / "real_scan.png")
def real_scan(scans: Path, poses: Path, driven: Path | None, out: Path) -> None:
    """Draw the map of the first scan of a recording."""
    path = None if driven is None else read_poses(driven).T_map_sensor[:, :3, 3]
    draw_real_scan(min(scans.glob("*.bin")), read_poses(poses).T_map_sensor[0], path, out)


if __name__ == "__main__":
    main()
