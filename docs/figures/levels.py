"""The figure of docs/concepts/levels.md: what a map with levels keeps of a bridge, and which surface is the ground.

    python -m docs.figures.levels

Writes docs/pictures/levels.png.
"""

from __future__ import annotations

from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LevelsConfig
from torchelev.sim import Lidar
from torchelev.sim.exact.covered_scenes import RISE, bridge
from torchelev.sim.poses import pose
from torchelev.viz.style import make_figure, styled, write

PICTURES = Path(__file__).parents[1] / "pictures"
DECK = 8 * RISE  # [m]
LIDAR = Lidar(rings=48, azimuths=360, fov_low_deg=-60.0, fov_high_deg=50.0)


def map_along(places: list[tuple[float, float, float]]) -> ElevationMap:
    """Return the map of a robot that stood at places x, y, height of the ground [m]."""
    grid = GridConfig(resolution=0.05, length_x=8.0, length_y=8.0)
    emap, scene = ElevationMap(ElevationMapConfig(grid=grid, levels=LevelsConfig())), bridge(8)
    for x, y, z in places:
        T_map_base = pose(torch.tensor([x, y, z + 0.4], dtype=torch.float64), 1.57)
        T_map_sensor = T_map_base.clone()
        T_map_sensor[2, 3] += 0.15
        emap.update(LIDAR.cast(scene, T_map_sensor)[None], T_map_sensor[None], T_map_base[None], dt=0.2)
    return emap


def draw(axes: Axes, emap: ElevationMap, robot: tuple[float, float], title: str) -> None:
    """Draw a section at x = 0, across the bridge, with the robot at y and the height of its ground [m]."""
    axes.add_patch(Rectangle((-1.0, DECK - 0.25), 2.0, 0.25, color="0.85", label="deck"))
    y = emap.cell_centers()[0, 80, :, 1]
    for layer, color in (("ceiling", "tab:purple"), ("elevation", "tab:brown")):
        axes.plot(y, emap.layer(layer)[0, 80], ".", color=color, markersize=3, label=layer)
    axes.add_patch(Rectangle((robot[0] - 0.3, robot[1] + 0.25), 0.6, 0.25, color="tab:orange", label="robot"))
    axes.set(xlim=(-3.5, 3.5), ylim=(-0.15, DECK + 0.9), xlabel="y [m]", ylabel="z [m]", title=title, aspect="equal")


@styled()
def main() -> None:
    """Draw the robot under the bridge, and on it."""
    below = [(0.0, -3.0 + 0.25 * k, 0.0) for k in range(13)]
    above = [(-2.3 + 0.2 * k, 0.0, DECK) for k in range(13)]
    figure = make_figure(9.0, 2.9)
    axes = figure.subplots(1, 2)
    draw(axes[0], map_along(below), (0.0, 0.0), "under the bridge, the road is the ground")
    draw(axes[1], map_along(below + above), (0.0, DECK), "on the bridge, the deck is")
    axes[0].legend(loc="center right", fontsize=7)
    write(figure, PICTURES / "levels.png")


if __name__ == "__main__":
    main()
