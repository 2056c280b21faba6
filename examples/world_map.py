"""Many robots, one world: merge the maps of robots whose heights disagree, and give the result to a robot that starts.

    python examples/world_map.py --picture world.png

Four robots walk side by side over the same ground. Each one's odometry has its own error of height, of up to 15 cm.
`SiteMap.merge` finds these offsets from the ground that two robots saw, and keeps one map of all. A robot that is
switched on in the middle gets it with `initialize_from`, and knows its surroundings before its first scan.
"""

import argparse

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim import HeightField, Lidar, MountedSensor, PoseErrorConfig, PoseErrors, mount
from torchelev.sim.poses import pose
from torchelev.site import SiteMap
from torchelev.viz.palette import ERRORS
from torchelev.viz.plot import Panel, save_layers

SIZE, B = 16.0, 4  # [m] side of the area, robots

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--steps", type=int, default=60)
parser.add_argument("--site", help="folder to keep the world map in; needs torchelev[site]")
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

# Waves, a platform and a ditch.
x, y = torch.meshgrid(*[torch.linspace(-10.0, 10.0, 401)] * 2, indexing="ij")
heights = 0.25 * torch.sin(0.7 * x) * torch.cos(0.5 * y) + 0.3 * ((x.abs() < 3) & (y > 1) & (y < 4))
field = HeightField((heights - 0.25 * ((y + 4).abs() < 0.5))[None], resolution=0.05)
tile = torch.zeros(B, dtype=torch.int64)  # all robots are on the same one
lidar = MountedSensor(Lidar(rings=32, azimuths=128, fov_low_deg=-75, fov_high_deg=-5, max_range=6.0), mount(z=0.4))
odometry = PoseErrors(PoseErrorConfig(bias_z=(-0.15, 0.15)), B, seed=2)

grid = GridConfig(resolution=0.1, length_x=8.0, length_y=8.0)
emap = ElevationMap(ElevationMapConfig(grid=grid), num_envs=B)
site, unaligned = SiteMap(resolution=0.1, path=args.site), SiteMap(resolution=0.1)
for step in range(args.steps):
    along = torch.full((B,), SIZE * step / args.steps - SIZE / 2)
    xy = torch.stack([torch.linspace(-6.0, 6.0, B), along], 1)
    z = field.height(tile[:1], xy[None])[0] + 0.5
    T_true = pose(torch.cat([xy, z[:, None]], 1).double(), torch.full((B,), torch.pi / 2))
    T_map_base = odometry(T_true, dt=0.2)  # what the robots believe
    emap.update(lidar(field, tile, T_true), lidar.T_map_sensor(T_map_base), T_map_base, dt=0.2)
    if step % 5 == 4 or step == args.steps - 1:
        report = site.merge(emap)
        unaligned.merge(emap, align=False)

errors, offsets = ((v - v.mean()).tolist() for v in ((T_map_base - T_true)[:, 2, 3], report.offsets))
for robot, (error, offset) in enumerate(zip(errors, offsets, strict=True)):
    print(f"robot {robot}: its height is off by {100 * error:.1f} cm from the mean, found {100 * offset:.1f} cm")
panels = []
for name, world in (("not aligned", unaligned), ("aligned", site)):
    area = world.window((0.0, 0.0), SIZE, SIZE, ["elevation"])
    elevation = torch.from_numpy(area.layers["elevation"])
    centers = (torch.arange(len(elevation)) + 0.5) * 0.1 - SIZE / 2
    truth = field.height(tile[:1], torch.cartesian_prod(centers, centers)[None]).view_as(elevation)
    error = elevation - truth
    error -= error.nanmedian()  # only differences of heights can be known
    known = elevation.isfinite().float().mean()
    print(f"{name}: {known:.0%} of {SIZE:g} x {SIZE:g} m known, median error {100 * error.abs().nanmedian():.1f} cm")
    panel = Panel(title=f"error, {name}", values=100 * error.numpy(), unit="cm", cmap=ERRORS, vmin=-15.0, vmax=15.0)
    panels.append(panel)

newcomer = ElevationMap(ElevationMapConfig(grid=grid), num_envs=1)
newcomer.initialize_from(site, pose(torch.tensor([[1.0, 0.5, 0.5]]).double(), torch.zeros(1)))
print(f"a robot that starts knows {newcomer.layer('elevation').isfinite().float().mean():.0%} of its window")
if args.picture:
    save_layers(
        args.picture, [Panel(title="world map", values=elevation.numpy(), unit="m"), *panels], extent=area.extent
    )
site.close()
