"""Many robots on one device: one update for all maps, one height scan for all policies.

    python examples/many_robots.py --num-envs 256
    python examples/many_robots.py --num-envs 4096 --device cuda

Every robot walks on terrain of its own and sees it through its own camera. No figure has been measured on a GPU yet.
"""

import argparse
import time

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan
from torchelev.sim import DepthCamera, MountedSensor, mount, terrain_grid
from torchelev.sim.poses import pose
from torchelev.viz.plot import Panel, save_layers

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=20)
parser.add_argument("--device", default="cpu")
parser.add_argument(
    "--compile", action="store_true", help="compile updates: takes a minute, then 191 ms in place of 767 on two cores"
)
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()
B, device = args.num_envs, torch.device(args.device)

# Six kinds of ground at four difficulties; robots share tiles, but each walks in a direction of its own.
KINDS = ("slope", "stairs_up", "stairs_down", "boxes", "rough", "rails")
terrain = terrain_grid(KINDS, num_levels=4, resolution=0.05, device=device)
tile_ids = torch.arange(B, device=device) % len(terrain.kind)
yaw = torch.linspace(-torch.pi, torch.pi, B, dtype=torch.float64, device=device)
camera = MountedSensor(DepthCamera(width=32, height=24, max_range=4.0), mount(pitch_deg=35, x=0.3, z=0.2))

emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=3.2, length_y=3.2)), B, device)
scan = HeightScan.isaac_lab()
if args.compile:
    emap.compile()
    emap.warm_up(num_points=32 * 24)


def seconds():
    if device.type == "cuda":
        torch.cuda.synchronize()  # else only the launch of the work is timed
    return time.perf_counter()


mapping = []
with torch.inference_mode():
    for step in range(args.steps):
        xy = 0.06 * step * torch.stack([yaw.cos(), yaw.sin()], -1)
        z = terrain.truth(tile_ids, xy[:, None].float())[:, 0].double() + 0.5
        T_map_base = pose(torch.cat([xy, z[:, None]], -1).cpu(), yaw.cpu()).to(device)
        points = camera(terrain.field, tile_ids, T_map_base)  # (B, N, 3)
        T_map_sensor = camera.T_map_sensor(T_map_base)
        start = seconds()
        emap.update(points, T_map_sensor, T_map_base, dt=0.1)
        observation, valid = scan(emap, T_map_base)  # (B, 187), for all policies
        mapping.append(seconds() - start)
        fallen = torch.zeros(B, dtype=torch.bool, device=device)  # yours: the robots whose episode ended
        emap.reset(mask=fallen)  # the host does not wait for the device

median = sorted(mapping[2:] or mapping)[len(mapping[2:] or mapping) // 2]
print(f"{B} robots, {points.shape[1]} points each, {torch.get_num_threads()} threads, {device}:")
print(f"{1e3 * median:.1f} ms for an update and a scan of all, {B / median:,.0f} robots per second")
if args.picture:
    layers, first = emap.layer("elevation").cpu().numpy(), min(B - 1, 18)  # the hardest of each kind, if there are 24
    shown = range(first, min(first + 6, B))
    panels = [Panel(title=terrain.kind[int(tile_ids[k])].replace("_", " "), values=layers[k], unit="m") for k in shown]
    save_layers(args.picture, panels, extent=(-1.6, 1.6, -1.6, 1.6), title=f"{len(shown)} of {B} maps")
