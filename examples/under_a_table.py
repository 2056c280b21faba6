"""Walk under a table: what is the ground, what hangs above it, and where a robot fits.

    python examples/under_a_table.py --picture table.png

A robot of 0.5 m walks below a table of 0.74 m. Its map holds two surfaces in the cells of the table; the floor is the
ground, as the robot reaches it, and the clearance says who fits. A policy reads the same as voxels.
"""

import argparse

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan, LevelsConfig
from torchelev.observations import VoxelCrop
from torchelev.planning.traversal_cost import TraversalCostConfig, traversal_cost
from torchelev.sim import Lidar, walk
from torchelev.sim.exact.covered_scenes import table

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--quick", action="store_true", help="few scans")
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

scene, lidar = table(), Lidar(rings=48, azimuths=360, fov_low_deg=-60.0, fov_high_deg=50.0)
grid = GridConfig(resolution=0.05, length_x=6.0, length_y=4.0)
emap = ElevationMap(ElevationMapConfig(grid=grid, levels=LevelsConfig(max_levels=3)))
path = walk(scene, [(-0.5, 0.0), (2.0, 0.0)], height=0.35, sway=0.3)
step = 4 if args.quick else 1
for T_map_sensor, T_map_base in zip(path.T_map_sensor[::step], path.T_map_base[::step], strict=True):
    emap.update(lidar.cast(scene, T_map_sensor)[None], T_map_sensor[None], T_map_base[None], dt=0.1 * step)

middle = torch.tensor([[[2.0, 0.2]]])  # (B, M, 2) [m] map frame
for layer in ("elevation", "ceiling", "clearance"):
    value, _ = emap.sample(middle, layer)
    print(f"{layer:9s} below the table: {float(value):5.2f} m")

around = ((emap.cell_centers()[0] - middle[0, 0]).abs() < torch.tensor([0.5, 0.15])).all(-1)
for height in (0.5, 0.9):
    cost = traversal_cost(emap, TraversalCostConfig(height=height))
    print(f"a robot of {height} m {'fits' if cost[0][around].isfinite().all() else 'does not fit'}")

T_map_base = path.T_map_base[-1:]
above, valid = HeightScan.points([(0.0, 0.0)], surface="ceiling")(emap, T_map_base)
print(f"the table is {float(above):.2f} m above the base")
voxels = VoxelCrop(length_z=1.2, offset=(0.6, 0.0, 0.15))(emap, T_map_base)
print(f"voxels {tuple(voxels.shape)}: {int((voxels == 0).sum())} free, {int((voxels == 1).sum())} occupied")

if args.picture:
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    row = grid.width // 2 + 3
    x = emap.cell_centers()[0, :, row, 0]
    for name, color in (("elevation", "tab:brown"), ("ceiling", "tab:purple")):
        left.plot(x, emap.layer(name)[0, :, row], ".", color=color, markersize=3, label=name)
    left.plot(*path.T_map_base[:, [0, 2], 3].T, color="tab:orange", label="base")
    left.set(xlabel="x [m]", ylabel="z [m]", ylim=(-0.1, 1.1), title="a section of the map")
    left.legend(loc="upper left", fontsize=7)
    right.imshow(voxels[0, :, voxels.shape[2] // 2].T, origin="lower", cmap=plt.get_cmap("Blues", 3), vmin=0, vmax=2)
    right.set(xlabel="x [voxels]", ylabel="z [voxels]", title="voxels: free, occupied and unknown (dark)")
    figure.savefig(args.picture, dpi=90)
