"""Train the traversability head for your robot: where can it stand, and how sure is that?

    python examples/own_head.py --picture head.png

This is the training at a size that shows how it works, and gives bad weights. The real command, which it prints, took 6
to 12 minutes for its maps and 8 to 10 for the training, on one core. Run it from a checkout, after `pip install -e
'.[io,rl]'`: trainings are not in the wheel.
"""

import argparse
import tempfile
from pathlib import Path

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LearnedTraversabilityConfig, RobotConfig
from torchelev.viz.plot import Panel, save_layers
from training.traversability.maps.data import make_batch
from training.traversability.maps.mapping import DataConfig
from training.traversability.trainer import FitConfig, Trainer

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--batches", type=int, default=6)
parser.add_argument("--steps", type=int, default=60)
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

# Sizes and abilities of your robot [m], [rad].
robot = RobotConfig(length=1.2, width=0.6, step_height=0.3, max_slope=0.5)

# Maps of simulated ground, three of four by sensors that err, and where the robot can stand on the true ground.
cfg = DataConfig(robot=robot, window=3.0, looks=(4, 6), headings=4, camera_pixels=(40, 30), lidar_rays=(16, 128))
batches = [make_batch(seed, cfg, exact=seed % 4 == 3) for seed in range(args.batches)]
trainer = Trainer(batches, FitConfig(steps=args.steps, batches_per_step=2), robot)
losses = [trainer.advance()["traversability"] for _ in range(args.steps)]
print(f"loss {losses[0]:.3f} -> {losses[-1]:.3f} in {args.steps} steps on {args.batches} batches")

# Ground that the training has not seen.
held_out = make_batch(10_000, cfg, ("obstacles",), resolution=0.05, exact=True)
with torch.no_grad():
    rating = trainer.net.eval()(*held_out.maps, resolution=held_out.resolution, robot=robot)
error = (rating.traversability - held_out.label).abs()[held_out.rated]
print(f"on other ground the rating is {float(error.mean()):.2f} away from the label, on average over cells")

# The weights are for maps of any size, of this robot alone.
with tempfile.TemporaryDirectory() as folder:  # use a folder that stays
    trainer.net.save(Path(folder, "weights.pt"))
    head = LearnedTraversabilityConfig(robot=robot, weights=Path(folder, "weights.pt"))
    grid = GridConfig(resolution=0.05, length_x=4.0, length_y=4.0)
    emap = ElevationMap(ElevationMapConfig(grid=grid, traversability=head))
emap.rate()  # after updates: .traversability and .confidence (B, H, W)

print("The real training, which can be stopped and continued with --resume:")
sizes = ",".join(f"{name}={getattr(robot, name)}" for name in ("length", "width", "step_height", "max_slope"))
print(f"  python -m training.traversability --robot {sizes} --out runs/my_robot")
if args.picture:
    known, label, trained = held_out.validity[0], held_out.label[0], rating.traversability[0]
    panels = [Panel(title="elevation [m]", values=held_out.elevation[0].where(known, torch.nan).numpy())]
    for title, values in (("label: share of headings", label), (f"rating after {args.steps} steps", trained)):
        panels.append(Panel(title=title, values=values.where(held_out.rated[0], torch.nan).numpy(), vmin=0.0, vmax=1.0))
    save_layers(args.picture, panels, extent=(-1.5, 1.5, -1.5, 1.5))
