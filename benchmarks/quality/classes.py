"""How well cells know their class when a fifth of the labels is wrong: by Bayes, by average, and by the last label.

    python -m benchmarks.quality.classes

A depth camera is carried over rough ground whose classes lie in patches. Each point brings the probabilities of four
classes; 20 % of the labels are those of another class, drawn anew for each point, or for patches of an image, as a
network errs. Accuracy is the share of seen cells whose most probable class is right; calibration compares that
probability with the share that is right, in ten bins. Writes benchmarks/results/classes.json.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import RESULTS
from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.sim import DepthCamera, MountedSensor, make_terrain, mount
from torchelev.sim.poses import pose

CLASSES, WRONG, SURE = 4, 0.2, 0.7  # share of wrong labels; probability that a label gives its class
PATCH = 0.5  # [m] side of the patches of ground
SCENES, STEPS = 8, 30
RULES = {
    "Bayes": ChannelConfig(kind="class", size=CLASSES),
    "average": ChannelConfig(kind="class_average", size=CLASSES, rate=0.3),
    "last value": ChannelConfig(kind="class_average", size=CLASSES, rate=1.0),
}
ERRORS = {"by point": 0, "by patch of the image": 12}  # pixels along the side of what errs together


def class_of(xy: Tensor, seeds: Tensor) -> Tensor:
    """Return the class of places (B, ..., 2) [m], in patches."""
    cell = torch.floor(xy / PATCH).to(torch.int64)
    mixed = cell[..., 0] * 73856093 ^ cell[..., 1] * 19349663 ^ seeds.view(-1, *[1] * (xy.ndim - 2)) * 83492791
    return (mixed // 7).remainder(CLASSES)


def label(truth: Tensor, width: int, side: int, generator: torch.Generator) -> Tensor:
    """Return probabilities (B, N, CLASSES), a share of which is of another class."""
    B, N = truth.shape
    draws = torch.rand(B, 2, N, generator=generator)
    if side:
        size = (N // width // side + 1, width // side + 1)
        coarse = torch.rand(B, 2, *size, generator=generator)
        fine = F.interpolate(coarse, scale_factor=side, mode="nearest")
        draws = fine[:, :, : N // width, :width].flatten(2)
    other = 1 + (draws[:, 1] * (CLASSES - 1)).to(torch.int64)
    given = torch.where(draws[:, 0] < WRONG, (truth + other).remainder(CLASSES), truth)
    return F.one_hot(given, CLASSES) * (SURE - (1 - SURE) / (CLASSES - 1)) + (1 - SURE) / (CLASSES - 1)


def walks() -> Iterator[tuple[Tensor, Tensor, Tensor, int]]:
    """Yield points (B, N, 3), poses of the camera and of the base, and the image's width, step by step."""
    terrain = make_terrain("rough", torch.linspace(0.2, 0.8, SCENES), length=12.0)
    camera = MountedSensor(DepthCamera(width=80, height=60, max_range=5.0), mount(pitch_deg=35, x=0.3, z=0.2))
    tiles = torch.arange(SCENES)
    for step in range(STEPS):
        xy = torch.tensor([[-2.0 + 0.08 * step, 0.2]], dtype=torch.float64).repeat(SCENES, 1)
        z = terrain.truth(tiles, xy[:, None].float()).double() + 0.5
        T_base = pose(torch.cat([xy, z], -1), torch.full((SCENES,), 0.1, dtype=torch.float64))
        yield camera(terrain.field, tiles, T_base), camera.T_map_sensor(T_base), T_base, 80


def evaluate(errors: str) -> dict[str, dict[str, Any]]:
    """Return accuracy and calibration of each rule for one kind of errors."""
    grid = GridConfig(resolution=0.05, length_x=6.0, length_y=6.0)
    maps = {
        name: ElevationMap(ElevationMapConfig(grid=grid, channels={"class": cfg}), SCENES)
        for name, cfg in RULES.items()
    }
    generator, seeds = torch.Generator().manual_seed(0), torch.arange(SCENES)
    for points, T_sensor, T_base, width in walks():
        world = points.double() @ T_sensor[:, :3, :3].mT + T_sensor[:, None, :3, 3]
        labels = label(class_of(world[..., :2].nan_to_num(), seeds), width, ERRORS[errors], generator)
        for emap in maps.values():
            emap.update(points, T_sensor, T_base, dt=0.1, features={"class": labels.float()})
    return {name: _score(emap, seeds) for name, emap in maps.items()}


def _score(emap: ElevationMap, seeds: Tensor) -> dict[str, Any]:
    probability, best = emap.layer("class").nan_to_num(-1.0).max(1)
    seen = probability >= 0
    truth = class_of(emap.cell_centers(), seeds)
    edge = torch.zeros_like(seen)
    for dim in (1, 2):
        edge |= (truth != truth.roll(1, dim)) | (truth != truth.roll(-1, dim))
    inner = seen & ~edge
    right, p = (best == truth)[inner].double(), probability[inner].double()
    bins = (10 * p).long().clamp(max=9)
    counts = torch.bincount(bins, minlength=10)
    shares = torch.bincount(bins, right, minlength=10) / counts.clamp(min=1)
    means = torch.bincount(bins, p, minlength=10) / counts.clamp(min=1)
    return {
        "cells": int(inner.sum()),
        "accuracy": float(right.mean()),
        "calibration_error": float(((shares - means).abs() * counts).sum() / counts.sum()),
        "mean_probability": float(p.mean()),
    }


def table(result: dict[str, Any]) -> str:
    """Tabulate accuracy and calibration."""
    rows = [
        [
            errors,
            rule,
            f"{100 * row['accuracy']:.1f}",
            f"{100 * row['mean_probability']:.1f}",
            f"{row['calibration_error']:.3f}",
        ]
        for errors, rules in result["errors"].items()
        for rule, row in rules.items()
    ]
    head = ["wrong labels", "rule", "cells right %", "mean probability %", "calibration error"]
    return markdown_table(head, rows)


def main() -> None:
    """Measure, write JSON and print the table."""
    result = {"wrong": WRONG, "classes": CLASSES, "scenes": SCENES, "errors": {name: evaluate(name) for name in ERRORS}}
    write_json(RESULTS / "classes.json", result)
    print(table(result))


if __name__ == "__main__":
    main()
