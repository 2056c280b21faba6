"""Compare the traversability heads beside a sharp step.

    python -m training.traversability.block

Flat ground with a square block of 1.2 m, 10 to 40 cm high, is mapped from above with 5 mm of noise. Compared are the
ratings along the block's middle line, from the ground onto the block, with the fraction of headings at which the robot
can stand on the true ground. Writes training/results/block.json and block.png.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import torch

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
from torchelev.viz.style import make_figure, styled, write
from training import RESULTS
from training.traversability.labels.labels import can_stand

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

ROBOT = RobotConfig()
HEIGHTS = (0.1, 0.15, 0.25, 0.4)  # [m] of the blocks; the robot's step height is 0.2 m
_SIDE = 1.2  # [m] of the block
SPACING, NOISE = 0.02, 0.005  # [m] between the points, and 1 sigma of their height
GRID = GridConfig(resolution=0.04, length_x=5.0, length_y=5.0)
_APPROACH = 1.2  # [m] length of the line on the ground before the block
_SCANS = 3
HEADINGS = 16
Head = LearnedTraversabilityConfig | TraversabilityConfig
HEADS: dict[str, Head] = {
    "learned": LearnedTraversabilityConfig(robot=ROBOT),
    "analytic": TraversabilityConfig(critical_slope=ROBOT.max_slope, critical_step=ROBOT.step_height),
}


def _block(height: float) -> Float[Tensor, "H W"]:
    """Return the heights [m] of 6 x 6 m of ground with a block in the middle."""
    axis = (torch.arange(301) - 150) * SPACING
    inside = axis.abs() <= _SIDE / 2
    return torch.where(inside[:, None] & inside, height, 0.0)


def _map(heights: Float[Tensor, "H W"], head: Head) -> ElevationMap:
    """Map the ground from above."""
    generator = torch.Generator().manual_seed(0)
    axis = (torch.arange(len(heights)) - len(heights) // 2) * SPACING
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    emap = ElevationMap(ElevationMapConfig(grid=GRID, traversability=head))
    for _ in range(_SCANS):
        z = heights + NOISE * torch.randn(heights.shape, generator=generator) - 1.0
        emap.update(torch.stack([x, y, z], -1).view(1, -1, 3), torch.eye(4)[None], torch.eye(4)[None], dt=0.0)
    return emap


def _profile(height: float) -> dict[str, Any]:
    """Return the label and the rating of each head along the line."""
    heights = _block(height)
    middle = GRID.width // 2
    maps = {name: _map(heights, head) for name, head in HEADS.items()}
    centers = maps["learned"].cell_centers()[0, :, middle].float()
    line = (centers[:, 0] >= -_SIDE / 2 - _APPROACH) & (centers[:, 0] <= 0)
    stands = can_stand(HeightField(heights[None], SPACING), torch.tensor([0]), centers[line][None], [ROBOT], HEADINGS)
    ratings = {name: emap.rate().traversability[0, line, middle].tolist() for name, emap in maps.items()}
    from_edge = centers[line, 0] + _SIDE / 2
    return {"height": height, "x": from_edge.tolist(), "label": stands[0].float().mean(-1).tolist(), **ratings}


def row(profile: dict[str, Any], name: str) -> list[str]:
    """Return the row of a head: its mean error, and its rating where the robot can stand at no heading."""
    label, rating = np.array(profile["label"]), np.array(profile[name])
    unsafe = rating[label == 0]
    high = f"{(unsafe >= 0.5).sum()} of {len(unsafe)}" if len(unsafe) else ""
    mean = f"{unsafe.mean():.2f}" if len(unsafe) else ""
    return [f"{100 * profile['height']:.0f} cm", name, f"{np.abs(rating - label).mean():.2f}", mean, high]


def table(profiles: list[dict[str, Any]]) -> str:
    """Tabulate the heads on each block."""
    header = ["block", "head", "mean error", "mean rating where no heading stands", "of these at 0.5 and more"]
    return markdown_table(header, [row(profile, name) for profile in profiles for name in HEADS])


@styled()
def draw(profiles: list[dict[str, Any]], path: Path) -> None:
    """Draw label and ratings along the line onto each block."""
    figure = make_figure(9, 3.2)
    axes = figure.subplots(1, len(profiles), sharey=True)
    for ax, profile in zip(axes, profiles, strict=True):
        ax.axvspan(0, max(profile["x"]), color="0.9", label="block")
        ax.plot(profile["x"], profile["label"], "k", drawstyle="steps-mid", label="truth")
        for name in HEADS:
            ax.plot(profile["x"], profile[name], label=name)
        ax.set(title=f"block of {100 * profile['height']:.0f} cm", xlabel="from its edge [m]", ylim=(-0.03, 1.03))
    axes[0].set_ylabel("traversability [0 to 1]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    write(figure, path)


@click.command(help=__doc__)
@click.option("--heights", type=float, multiple=True, default=HEIGHTS, show_default=True, help="Of the blocks [m].")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
def main(heights: tuple[float, ...], out: Path) -> None:
    """Measure, write JSON and figure and print the table."""
    profiles = [_profile(height) for height in heights]
    write_json(out / "block.json", {"robot": vars(ROBOT), "profiles": profiles})
    draw(profiles, out / "block.png")
    click.echo(table(profiles))


if __name__ == "__main__":
    main()
