"""Compare the completion network with other ways to fill a map, on held-out ground.

    python -m training.completion.evaluate --weights weights.pt

Without --weights, the shipped weights are evaluated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import click
import torch
from torch import Tensor
from tqdm import tqdm

from torchelev.app.results import markdown_table, write_json
from torchelev.completion.net import CompletionNet
from torchelev.filters import Filter
from training.completion.cells import FARTHEST, distances
from training.completion.maps import YARD, YARD_CONFIG, TrueMap, WalkConfig, Walks, make_walks
from training.options import jobs_option


class Split(NamedTuple):
    """The maps to evaluate on, of one of the splits of `maps.SPLITS`."""

    cfg: WalkConfig
    resolutions: tuple[float, ...]  #: [m] of the maps


SPLITS = {
    "held_out": Split(WalkConfig(), (0.02, 0.04, 0.08)),
    "unseen": Split(WalkConfig(), (0.02, 0.04, 0.08)),
    "held_out_yards": Split(YARD_CONFIG, (0.04, 0.08)),
}
Splits = Mapping[str, Split]
DISTANCES = (0.0, 0.1, 0.3, 1.0, FARTHEST)  # [m] limits of the groups of unknown cells
_SEED = 0  # of the maps, the same for all weights
_WORST = 0.05  # share of the cells
FILLS = {
    "minimum": "inpaint_minimum",
    "nearest": "inpaint_nearest",
    "diffusion": "inpaint_diffusion",
    "Telea": "inpaint_telea",
    "Navier-Stokes": "inpaint_navier_stokes",
}
COMPLETED = "CompletionNet"
_SUFFIXES = {"held_out": "", "unseen": ", never trained on", "held_out_yards": ", in yards"}
Answer: TypeAlias = Callable[[TrueMap], Sequence[Any]]  # mean (B, H, W) [m], and standard deviation or None


class Errors(NamedTuple):
    """The errors of n cells."""

    error: Tensor  #: [m] signed
    std: Tensor  #: [m] as claimed; NaN by fills that claim none
    distance: Tensor  #: [m] from the nearest known cell; 0 where measured
    kind: list[str]  #: of the ground, of each map
    map: Tensor  #: number of the map in `kind`


def fill(name: str) -> Answer:
    """Return a filter as an answer, which takes the nearest known height where the filter leaves a cell unknown."""

    def answer(maps: TrueMap) -> tuple[Tensor, None]:
        layer = maps.layers.elevation, maps.layers.validity
        near, _ = Filter("inpaint_nearest")(layer, resolution=maps.resolution)
        values, known = Filter(FILLS[name])(layer, resolution=maps.resolution)
        return torch.where(known, values, near), None

    return answer


def learned(net: CompletionNet) -> Answer:
    """Return a network as an answer."""
    return lambda maps: net(*maps.layers, resolution=maps.resolution)


@torch.no_grad()
def all_errors(answers: dict[str, Answer], maps: list[TrueMap]) -> dict[str, Errors]:
    """Return the errors of each answer."""
    found: dict[str, list[list[Tensor]]] = {name: [] for name in answers}
    kinds: list[str] = []
    for entry in maps:
        distance = distances(entry)
        counts = entry.is_inside & (distance < FARTHEST)
        number = len(kinds) + torch.arange(len(entry.kinds))[:, None, None].expand_as(counts)
        kinds += entry.kinds
        for name, answer in answers.items():
            mean, std = answer(entry)
            std = torch.full_like(mean, torch.nan) if std is None else std
            found[name].append([column[counts] for column in (mean - entry.truth, std, distance, number)])
    joined = {name: [torch.cat(column) for column in zip(*parts, strict=True)] for name, parts in found.items()}
    return {name: Errors(error, std, distance, kinds, of) for name, (error, std, distance, of) in joined.items()}


def measure(errors: Errors, chosen: Tensor) -> dict[str, float | int]:
    """Return the metrics [m] of some cells."""
    error, std = errors.error[chosen].abs(), errors.std[chosen]
    if not len(error):
        return {"cells": 0}
    worst = error.topk(max(1, round(_WORST * len(error)))).values
    values = {"mae": error.mean(), "rmse": error.square().mean().sqrt(), "worst": worst.mean()}
    if not std.isnan().any():
        values |= {"within_2_std": (error <= 2 * std).float().mean(), "std": std.mean()}
    return {"cells": len(error)} | {name: round(float(value), 5) for name, value in values.items()}


def groups(errors: Errors) -> Iterator[tuple[str, Tensor]]:
    """Yield the names of groups of cells, and which cells they hold."""
    distance = errors.distance
    yield "unknown", distance > 0
    yield "measured", distance == 0
    for low, high in zip(DISTANCES, DISTANCES[1:], strict=False):
        yield f"{low:g} to {high:g} m", (distance > low) & (distance <= high)
    of_kind = torch.tensor([sorted(set(errors.kind)).index(kind) for kind in errors.kind])[errors.map]
    for k, kind in enumerate(sorted(set(errors.kind))):
        yield kind, (of_kind == k) & (distance > 0)


def evaluate(
    answers: dict[str, Answer], data: Path, num_walks: int, jobs: int, splits: Splits = SPLITS
) -> dict[str, Any]:
    """Measure answers, and the fills, on held-out ground.

    Args:
        answers: by name.
        data: folder of the walks; missing ones are made.
        num_walks: for each split and resolution.
        jobs: processes that make walks.
        splits: the ground, and the resolutions.

    Returns:
        `result[split][resolution][answer][group][metric]`.
    """
    answers = answers | {name: fill(name) for name in FILLS}
    result: dict[str, Any] = {}
    for split, (cfg, resolutions) in splits.items():
        for resolution in resolutions:
            walks = Walks(data, split, _SEED, cfg, resolution)
            make_walks(walks, num_walks, jobs)
            bar = tqdm(range(num_walks), desc=f"{split} at {100 * resolution:g} cm", unit="walk")
            errors = all_errors(answers, [maps for index in bar for maps in walks.read(index)])
            measured = {name: {g: measure(each, chosen) for g, chosen in groups(each)} for name, each in errors.items()}
            result.setdefault(split, {})[f"{resolution:g}"] = measured
    return result


def table(result: dict[str, Any]) -> str:
    """Tabulate the mean absolute errors [cm], and how often the first answer holds the ground within two std."""
    lines: list[list[str]] = []
    names: list[str] = []
    for split in SPLITS:
        for resolution, of_answers in result[split].items():
            names = list(of_answers)
            for group, first in of_answers[names[0]].items():
                if not first["cells"] or group == YARD:
                    continue
                values = [f"{100 * of_answers[name][group]['mae']:.1f}" for name in names]
                lines.append([split, resolution, group, *values, f"{100 * first['within_2_std']:.1f}"])
    return markdown_table(["split", "resolution [m]", "cells", *names, "within 2 std [%]"], lines)


def summary(result: dict[str, Any]) -> str:
    """Tabulate the mean absolute errors [cm] at 4 cm, by kind of ground and by distance; of seeds, their mean."""
    lines: list[list[str]] = []
    names: list[str] = []
    for split in SPLITS:
        answers = result[split]["0.04"]
        seeds = [COMPLETED, *(name for name in answers if name.startswith("seed"))]
        names = [name for name in answers if name not in seeds]
        for group in answers[COMPLETED]:
            cells = [answers[name][group] for name in seeds]
            if not cells[0]["cells"] or group == YARD:
                continue
            own = [100 * cell["mae"] for cell in cells]
            within = 100 * sum(cell["within_2_std"] for cell in cells) / len(cells)
            spread = f" ({min(own):.1f} to {max(own):.1f})" if len(own) > 1 else ""
            label = group.replace("_", " ") + _SUFFIXES[split]
            others = [f"{100 * answers[name][group]['mae']:.1f}" for name in names]
            lines.append([label, f"{sum(own) / len(own):.1f}{spread}", *others, f"{within:.0f}"])
    return markdown_table(["cells", COMPLETED, *names, "within 2 std [%]"], lines)


@click.command(help=__doc__)
@click.option("--weights", type=click.Path(path_type=Path, exists=True), default=None, help="Weights to evaluate.")
@click.option("--walks", type=click.IntRange(1), default=10, show_default=True, help="Per split and resolution.")
@click.option("--data", type=click.Path(path_type=Path), default=Path("runs/completion/data"), show_default=True)
@click.option("--out", type=click.Path(path_type=Path), default=None, help="Write the result to this JSON file.")
@jobs_option
@click.pass_obj
def main(splits: Splits | None, weights: Path | None, walks: int, data: Path, out: Path | None, jobs: int) -> None:
    """Evaluate and print the table."""
    net = CompletionNet.from_pretrained(weights)
    result = evaluate({COMPLETED: learned(net)}, data, walks, jobs, splits or SPLITS)
    if out is not None:
        write_json(out, result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
