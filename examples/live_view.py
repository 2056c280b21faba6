"""Watch robots of a training environment and their maps in the browser.

    python examples/live_view.py
    python examples/live_view.py --task Quadruped --num-envs 16

The page lets you choose the robot. Robots act at random here; put your policy in place of `act`. Needs
`pip install 'torchelev[view,rl]'`.
"""

import argparse

import gymnasium
import torch

import envs  # noqa: F401  # registers the environments
from torchelev import HeightScan
from torchelev.viz.live import LiveView, take_snapshot
from torchelev.viz.plot import Panel, save_layers

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--task", choices=("TerrainNav", "Quadruped"), default="TerrainNav")
parser.add_argument("--num-envs", type=int, default=8)
parser.add_argument("--steps", type=int, default=1_000_000, help="then the program ends, else at Ctrl-C")
parser.add_argument("--port", type=int, default=8080)
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

env = gymnasium.make_vec(f"torchelev/{args.task}-v0", num_envs=args.num_envs, perception="map")
task = env.unwrapped.task
scan, emap = HeightScan.isaac_lab(), task.sight.emap


def act():
    return 0.3 * torch.randn(args.num_envs, task.num_actions)


def believed_pose():
    return task.view().T_estimated if args.task == "Quadruped" else task.sight.T_estimated


env.reset(seed=0)
with torch.inference_mode(), LiveView(emap, port=args.port) as view:
    num_shown = 0
    for _ in range(args.steps):
        env.step(act())
        T = believed_pose()
        num_shown += view.show(T, scan=scan.xy(T))  # returns at once; most calls show nothing

print(f"{num_shown} pictures in {args.steps} steps")
if args.picture:
    saved = take_snapshot(emap).map
    panel = Panel(title="elevation of robot 0", values=saved.layers["elevation"], unit="m")
    save_layers(args.picture, [panel], extent=saved.extent)
