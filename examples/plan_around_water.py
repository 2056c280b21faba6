"""Plan by what the ground is made of: around water, through a little mud, over a flat map.

    python examples/plan_around_water.py --picture path.png

A robot looks around on flat ground with a pond and mud beside it. A simulated network gives each point the class that
it sees, wrong for one in five; the map gathers the probabilities. `class_costs` says what a metre on each class costs.
"""

import argparse
import math

import torch

from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig
from torchelev.planning.planner import plan
from torchelev.planning.traversal_cost import TraversalCostConfig, traversal_cost
from torchelev.sim import DepthCamera, Scene, turn_on_the_spot
from torchelev.viz.plot import Panel, draw_layers

CLASSES = ("grass", "mud", "water")
WRONG = 0.2  # share of wrong labels
COSTS = {"terrain": {"mud": 2.0, "water": math.inf}}  # a metre of mud costs two of grass


def truth(xy):
    """Return the class of places (..., 2) [m]: a pond, open to one side, and mud at its shore."""
    x, y = xy.unbind(-1)
    is_water = ((x / 0.9) ** 2 + ((y - 0.6) / 1.5) ** 2) < 1
    is_mud = (x.abs() < 0.5) & (y < -0.5) & (y > -1.9)
    return torch.where(is_water, 2, torch.where(is_mud, 1, 0))


def classify(points, generator):
    """Return the probabilities (N, 3) of the classes that a network sees at points (N, 3) [m], map frame."""
    labels = truth(points[:, :2])
    others = (labels + torch.randint(1, len(CLASSES), labels.shape, generator=generator)) % len(CLASSES)
    is_wrong = torch.rand(labels.shape, generator=generator) < WRONG
    return torch.nn.functional.one_hot(torch.where(is_wrong, others, labels), len(CLASSES)).float()


parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--quick", action="store_true", help="few pixels")
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

scene, camera = Scene(), DepthCamera(width=64, height=48) if args.quick else DepthCamera()
channels = {"terrain": ChannelConfig(kind="class", names=CLASSES)}
grid = GridConfig(resolution=0.08, length_x=6.4, length_y=5.6)
emap = ElevationMap(ElevationMapConfig(grid=grid, drift=None, channels=channels))
generator = torch.Generator().manual_seed(0)
for place in ((-1.8, 0.2), (1.8, 0.2), (0.0, -1.8), (0.0, 2.3)):  # where the robot has looked around
    for T in turn_on_the_spot(n=12, scene=scene, at=place).T_map_sensor:
        points = camera.cast(scene, T)
        in_map = points @ T[:3, :3].T.to(points.dtype) + T[:3, 3].to(points.dtype)
        emap.update(points[None], T[None], dt=0.1, features={"terrain": classify(in_map, generator)[None]})

start, goal = torch.tensor([[-2.2, 0.2]]), torch.tensor([[2.2, 0.2]])  # (B, 2) [m] map frame
paths = {}
for name, costs in (("by the heights alone", {}), ("by classes, too", COSTS)):
    path = plan(emap, start, goal, TraversalCostConfig(class_costs=costs, inflation_radius=0.2))
    on = torch.bincount(truth(path.xy[0, : int(path.count)]), minlength=3) * float(path.length / path.count)
    shares = ", ".join(f"{metres:.1f} m of {kind}" for kind, metres in zip(CLASSES, on.tolist(), strict=True))
    print(f"{name}: {path.explain()[0]}; {float(path.length):.2f} m: {shares}")
    paths[name] = path.xy[0].numpy()

if args.picture:
    layers = {name: emap.layer(name) for name in ("terrain.mud", "terrain.water")}
    layers["cost of a metre"] = traversal_cost(emap, TraversalCostConfig(class_costs=COSTS, inflation_radius=0.2))
    panels = [Panel(title=name, values=values[0].nan_to_num(posinf=math.nan)) for name, values in layers.items()]
    figure = draw_layers(panels, extent=(-3.2, 3.2, -2.8, 2.8))
    for axes in figure.axes[:3]:
        for (name, xy), color in zip(paths.items(), ("tab:orange", "black"), strict=True):
            axes.plot(xy[:, 0], xy[:, 1], color=color, label=name)
        axes.plot(*goal[0], "k*", markersize=9)
    figure.axes[0].legend(loc="lower right", fontsize=7)
    figure.savefig(args.picture, dpi=100)
