"""A trotting quadruped's map without a self-filter, with one box, and with the shapes of its links.

    python -m docs.figures.own_legs

Writes docs/pictures/own_legs.png.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from benchmarks.self_filter.robot import Scan, make_body, make_cameras, walk
from torchelev import BodyConfig, ElevationMap, ElevationMapConfig, GridConfig, RobotBody, SensorConfig
from torchelev.viz.palette import HEIGHTS
from torchelev.viz.style import draw_cells, make_figure, styled, write

PICTURES = Path(__file__).parents[1] / "pictures"
GRID = GridConfig(resolution=0.02, length_x=1.4, length_y=1.0)
BODIES: dict[str, BodyConfig | RobotBody | None] = {
    "no body": None,
    "one box, down to the ground": BodyConfig(lower=(-0.42, -0.2, -0.36), upper=(0.42, 0.2, 0.1)),
    "the shapes of its links": make_body(),
}


def map_of(body: BodyConfig | RobotBody | None, scans: list[Scan]) -> ElevationMap:
    """Return the map after some scans of one robot."""
    cfg = ElevationMapConfig(grid=GRID, sensor=SensorConfig(body=body))
    emap = ElevationMap(cfg)
    for scan in scans:
        links = scan.T_base_links if cfg.sensor.links else None
        emap.update(scan.points, scan.T_map_sensor, scan.T_map_base, dt=0.1, T_base_links=links)
    return emap


def heights_of(emap: ElevationMap) -> tuple[NDArray, tuple[float, float, float, float]]:
    """Return the elevation (H, W) and its extent in the map frame [m]."""
    x, y, _ = emap.center[0].tolist()
    half_x, half_y = GRID.length_x / 2, GRID.length_y / 2
    return emap.layer("elevation")[0].numpy(), (x - half_x, x + half_x, y - half_y, y + half_y)


@styled()
def draw(out: Path, scans: int = 12) -> None:
    """Draw the three maps side by side."""
    seen = walk(1, scans, make_cameras(80, 60))
    figure = make_figure(10, 2.6)
    axes = figure.subplots(1, 3, sharey=True)
    for ax, (name, body) in zip(axes, BODIES.items(), strict=True):
        heights, extent = heights_of(map_of(body, seen))
        image = draw_cells(ax, heights, extent, HEIGHTS, vmin=0.0, vmax=0.3)
        highest = np.nanmax(heights)
        ax.set_title(f"{name}: up to {100 * highest:.0f} cm", fontsize=10)
        ax.set_xlabel("x [m]")
    axes[0].set_ylabel("y [m]")
    figure.colorbar(image, ax=axes, pad=0.01, extend="max").set_label("elevation [m]")
    write(figure, out)


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES / "own_legs.png")
def main(out: Path) -> None:
    """Draw the picture."""
    draw(out)


if __name__ == "__main__":
    main()
