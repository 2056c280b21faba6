"""A fleet in several processes: each rank maps its own robots, and all of them share one world map.

    torchrun --nproc-per-node 2 examples/fleet_torchrun.py
    torchrun --nproc-per-node 2 examples/fleet_torchrun.py --path site    # on disk; needs torchelev[site]

Every robot walks a lane of its own, and its heights drift. All ranks call `merge`, which finds the drifts from the
ground that robots share, those of other ranks included. On several machines, give torchrun `--nnodes` and its
rendezvous.
"""

import argparse
import os
from datetime import timedelta

import torch
import torch.distributed as dist

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim import DepthCamera, MountedSensor, make_terrain, mount
from torchelev.sim.poses import pose
from torchelev.site import SiteMap
from torchelev.viz.plot import Panel, save_layers

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--robots", type=int, default=2, help="of each rank")
parser.add_argument("--steps", type=int, default=30)
parser.add_argument("--path", help="folder of the site, which all ranks see; by default, it is in memory")
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

# After this time, ranks that wait for one that has died raise LostRankError.
if "RANK" in os.environ:
    dist.init_process_group("gloo", timeout=timedelta(seconds=60))
rank, size = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
group = dist.group.WORLD if dist.is_initialized() else None

# The same ground on all ranks. Lanes are 1 m apart, so that windows overlap.
B, total = args.robots, args.robots * size
robot = rank * B + torch.arange(B, dtype=torch.float64)
terrain = make_terrain("rough", torch.tensor([0.4]), length=12.0, resolution=0.05, seed=0)
tile_ids = torch.zeros(B, dtype=torch.int64)
camera = MountedSensor(DepthCamera(width=48, height=32, max_range=4.0), mount(pitch_deg=35, x=0.3, z=0.2))
drift = torch.where(robot > 0, 0.03 * torch.cos(2 * robot), 0.0)  # [m]

emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=6.0, length_y=6.0)), B)
site = SiteMap(0.1, args.path, group=group)
with torch.inference_mode():
    for step in range(args.steps):
        x, y = torch.full((B,), 0.1 * step - 1.5, dtype=torch.float64), robot - (total - 1) / 2
        ground = terrain.truth(tile_ids, torch.stack([x, y], 1)[:, None].float())[:, 0].double()
        T_map_base = pose(torch.stack([x, y, ground + 0.5], 1), torch.zeros(B, dtype=torch.float64))
        points = camera(terrain.field, tile_ids, T_map_base)
        T_map_base[:, 2, 3] += drift  # what the robot believes
        emap.update(points, camera.T_map_sensor(T_map_base), T_map_base, dt=0.1)
        if step % 10 == 9 or step == args.steps - 1:
            merged = site.merge(emap)  # waits for all ranks, and takes the robots of all

offsets = ", ".join(f"{1000 * offset:.0f}" for offset in merged.offsets - merged.offsets.mean())
expected = ", ".join(f"{1000 * offset:.0f}" for offset in drift - drift.mean())
x_min, x_max, y_min, y_max = site.extent
report = f"its robots' heights drifted by {expected} mm from their mean, and were found at {offsets} mm"
extent = f"the site of {total} robots has {len(site)} tiles, {x_max - x_min:.1f} x {y_max - y_min:.1f} m"
print(f"rank {rank}: {report}\nrank {rank}: {extent}\n", end="", flush=True)  # at once, or ranks' lines would mix
if args.picture and rank == 0:
    window = site.window(((x_min + x_max) / 2, (y_min + y_max) / 2), x_max - x_min, y_max - y_min, ["elevation"])
    save_layers(
        args.picture, [Panel(title="elevation", values=window.layers["elevation"], unit="m")], extent=site.extent
    )
site.close()
if group is not None:
    dist.barrier()
    dist.destroy_process_group()
