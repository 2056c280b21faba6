"""Does the learned head see a sharp step? `python -m training.traversability.block`

Flat ground with a block of 1.2 m, 10 to 40 cm high, mapped from above with 5 mm of noise and no other error: what the
heads say along the block's middle line, from the ground onto the block, beside where the robot stands on the true
ground. Writes training/results/block.json and block.png.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchelev import (
    ElevationMap,
    ElevationMapConfig,
    GridConfig,
    LearnedTraversabilityConfig,
    RobotConfig,
    TraversabilityConfig,
)
from torchelev.app.results import markdown_table, write_json
from torchelev.sim import HeightField
from training.traversability.labels.labels import stand

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

RESULTS = Path(__file__).parents[1] / "results"
ROBOT = RobotConfig()
HEIGHTS = (0.1, 0.15, 0.25, 0.4)  # [m] of blocks; the robot's steps are 0.2 m
SIDE, SPACING, NOISE = 1.2, 0.02, 0.005  # [m] of the block, between points, of the points
GRID = GridConfig(resolution=0.04, length_x=5.0, length_y=5.0)
FAR = 1.2  # [m] of the line on the ground before the block's edge
SCANS = 3
HEADINGS = 16
HEADS = {
    "learned": LearnedTraversabilityConfig(robot=ROBOT),
    "analytic": TraversabilityConfig(critical_slope=ROBOT.max_slope, critical_step=ROBOT.step_height),
}


def block(height: float) -> Float[Tensor, "H W"]:
    """Return the samples of 6 m of ground, the block in its middle."""
    axis = (torch.arange(301) - 150) * SPACING
    inside = axis.abs() <= SIDE / 2
    return torch.where(inside[:, None] & inside, height, 0.0)


def mapped(heights: Float[Tensor, "H W"], head: Any) -> ElevationMap:
    """Map the ground from above."""
    generator = torch.Generator().manual_seed(0)
    axis = (torch.arange(len(heights)) - len(heights) // 2) * SPACING
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    emap = ElevationMap(ElevationMapConfig(grid=GRID, traversability=head))
    for _ in range(SCANS):
        z = heights + NOISE * torch.randn(heights.shape, generator=generator) - 1.0
        emap.update(torch.stack([x, y, z], -1).view(1, -1, 3), torch.eye(4)[None], torch.eye(4)[None], dt=0.0)
    return emap


def profile(height: float) -> dict[str, Any]:
    """Return the label and each head's rating of the cells of the line."""
    heights = block(height)
    middle = GRID.width // 2
    maps = {name: mapped(heights, head) for name, head in HEADS.items()}
    centers = maps["learned"].cell_centers()[0, :, middle].float()
    line = (centers[:, 0] >= -SIDE / 2 - FAR) & (centers[:, 0] <= 0)
    stands = stand(HeightField(heights[None], SPACING), torch.tensor([0]), centers[line][None], [ROBOT], HEADINGS)
    ratings = {name: emap.rate().traversability[0, line, middle].tolist() for name, emap in maps.items()}
    before = centers[line, 0] + SIDE / 2
    return {"height": height, "x": before.tolist(), "label": stands[0].float().mean(-1).tolist(), **ratings}


def row(found: dict[str, Any], name: str) -> list[str]:
    """Return how far a head is off, and what it says where the robot stands at no heading."""
    label, says = np.array(found["label"]), np.array(found[name])
    nowhere = says[label == 0]
    share = f"{(nowhere >= 0.5).sum()} of {len(nowhere)}" if len(nowhere) else ""
    mean = f"{nowhere.mean():.2f}" if len(nowhere) else ""
    return [f"{100 * found['height']:.0f} cm", name, f"{np.abs(says - label).mean():.2f}", mean, share]


def table(profiles: list[dict[str, Any]]) -> str:
    """Tabulate every head on every block."""
    header = ["block", "head", "mean error", "mean rating where no heading stands", "of these at 0.5 and more"]
    return markdown_table(header, [row(found, name) for found in profiles for name in HEADS])


def draw(profiles: list[dict[str, Any]], path: Path) -> None:
    """Draw label and ratings over the way onto each block."""
    figure = Figure(figsize=(3 * len(profiles), 2.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(profiles), sharey=True)
    for ax, found in zip(axes, profiles, strict=True):
        ax.axvspan(0, max(found["x"]), color="0.9", label="block")
        ax.plot(found["x"], found["label"], "k", drawstyle="steps-mid", label="truth")
        for name in HEADS:
            ax.plot(found["x"], found[name], label=name)
        ax.set(title=f"block of {100 * found['height']:.0f} cm", xlabel="from its edge [m]", ylim=(-0.03, 1.03))
    axes[0].set_ylabel("traversability")
    axes[-1].legend(fontsize=8)
    figure.savefig(path, dpi=80)


@click.command()
def main() -> None:
    """Rate the ground before and on blocks."""
    profiles = [profile(height) for height in HEIGHTS]
    write_json(RESULTS / "block.json", {"robot": vars(ROBOT), "profiles": profiles})
    draw(profiles, RESULTS / "block.png")
    click.echo(table(profiles))


if __name__ == "__main__":
    main()
