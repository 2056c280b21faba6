"""Plan across a map, and check the robot's footprint all along the path.

    python examples/planning.py --picture path.png

A robot looks around in a hall with a wall that has a narrow and a wide gap. `plan` finds the cheapest path,
`check_path` says whether the footprint fits everywhere. Planned as a point, the path leads through the narrow gap,
where the check refuses it; planned with the robot's width, it takes the wide one.
"""

import argparse

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.planning.path_check import check_path
from torchelev.planning.planner import plan
from torchelev.planning.standing import place_footprint
from torchelev.planning.traversal_cost import TraversalCostConfig
from torchelev.sim import DepthCamera, Scene, turn_on_the_spot
from torchelev.sim.exact.scenes import block, steps
from torchelev.viz.plot import Panel, draw_layers

LENGTH, WIDTH = 0.7, 0.4  # [m] of the robot
CORNERS = torch.tensor([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * torch.tensor([LENGTH / 2, WIDTH / 2])  # base frame
WALLS = [block(-0.2, 0.0, y0, y1, 0.6) for y0, y1 in ((-2.9, -1.5), (-0.6, 0.5), (0.8, 2.9))]  # gaps: 0.9 m, 0.3 m
SCENE = Scene(boxes=(*WALLS, block(0.9, 1.3, -0.6, 0.2, 0.3), *steps(1.0, 1.4, 2.6, count=3, rise=0.05, run=0.3)))

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--quick", action="store_true", help="few pixels")
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

camera = DepthCamera(width=64, height=48) if args.quick else DepthCamera()
emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.04, length_x=6.4, length_y=5.6), drift=None))
for place in ((1.6, -1.6), (0.6, 1.4), (-1.2, 1.2), (-1.6, -1.2)):  # where the robot has looked around
    look = turn_on_the_spot(n=12, scene=SCENE, at=place)
    for T_map_sensor in look.T_map_sensor:  # without T_map_base the window stays; with it, it would follow the robot
        emap.update(camera.cast(SCENE, T_map_sensor)[None], T_map_sensor[None], dt=0.1)

start, goal = torch.tensor([[-1.6, 0.5]]), torch.tensor([[1.8, 0.7]])  # (B, 2) [m] map frame
standing = place_footprint(emap, CORNERS, torch.cat([start, torch.zeros(1, 1)], 1)[:, None])[:, 0]
paths = {}
for name, radius in (("as a point", 0.0), ("as wide as the robot", WIDTH / 2)):
    path = plan(emap, start, goal, TraversalCostConfig(inflation_radius=radius), standing=standing)
    check = check_path(emap, path.poses(), CORNERS, standing=standing)
    print(f"{name}: {path.explain()[0]}; {float(path.length):.2f} m; {check.explain()[0]}")
    paths[name] = path.xy[0].numpy(), bool((path.reached & check.safe).all())

if args.picture:
    layers = {
        "elevation": emap.layer("elevation")[0].numpy(),
        "traversability": emap.layer("traversability")[0].numpy(),
    }
    panels = [Panel(title=name, values=values) for name, values in layers.items()]
    figure = draw_layers(panels, extent=(-3.2, 3.2, -2.8, 2.8))
    for axes in figure.axes[:2]:
        for (name, (xy, is_safe)), color in zip(paths.items(), ("tab:orange", "black"), strict=True):
            label = f"{name}: {'safe' if is_safe else 'refused'}"
            axes.plot(xy[:, 0], xy[:, 1], color=color, linestyle="-" if is_safe else "--", label=label)
        axes.plot(*goal[0], "k*", markersize=9)
    figure.axes[0].legend(loc="lower right", fontsize=7)
    figure.savefig(args.picture, dpi=100)
