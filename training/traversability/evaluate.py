"""How good is a learned head? `python -m training.traversability.evaluate --weights runs/traversability/weights.pt`"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchelev.app.results import markdown_table, write_json
from torchelev.robot import RobotConfig
from torchelev.traversability.net import TraversabilityNet
from training.traversability.heads import Score, baselines, family
from training.traversability.maps.data import MappedTerrain, data_set
from training.traversability.maps.mapping import DataConfig
from training.traversability.maps.terrain import KINDS, UNSEEN_KINDS
from training.traversability.metrics import SAFE, RatedMap, calibration_error, measure
from training.traversability.robot import RobotType

RESOLUTIONS = (0.02, 0.04, 0.08)  # [m]
SPLITS = {"held_out": KINDS, "unseen": UNSEEN_KINDS, "held_out_exact": KINDS}
EVALUATION_SEED = 0  # of the maps: the same for all weights
COLUMNS = {
    "average_precision": "AP safe",
    "average_precision_unsafe": "AP unsafe",
    "roc_auc": "ROC AUC",
    "iou": "IoU at 0.5",
    "calibration_error": "calibration error",
    "false_safe": "false safe",
    "inflation_cm": "inflation at 0.5 [cm]",
    "inflation_at_recall_cm": "inflation at recall [cm]",
}
LOWER_IS_BETTER = ("calibration_error", "false_safe", "inflation_cm", "inflation_at_recall_cm")


def learned(net: TraversabilityNet) -> Score:
    """Return a net's traversability as a score."""
    return lambda maps: net(*maps.maps, resolution=maps.resolution, robot=maps.robot).traversability


@torch.no_grad()
def score(head: Score, batches: list[MappedTerrain]) -> list[Tensor]:
    """Return what a head says of each batch."""
    return [head(maps) for maps in batches]


def as_maps(scores: list[Tensor], batches: list[MappedTerrain]) -> list[tuple[str, RatedMap, np.ndarray]]:
    """Return each map's kind of ground, its scores, and where it knows the elevation."""
    rows = []
    for values, maps in zip(scores, batches, strict=True):
        layers = zip(maps.kinds, values, maps.label, maps.rated, maps.validity, strict=True)
        for kind, value, label, rated, known in layers:
            rated_map = RatedMap(value.double().numpy(), label.numpy(), rated.numpy(), maps.resolution)
            rows.append((kind, rated_map, known.numpy()))
    return rows


def metrics(scores: list[Tensor], batches: list[MappedTerrain]) -> dict[str, Any]:
    """Return the metrics over all rated cells, over those whose elevation is known, and by kind of ground."""
    rows = as_maps(scores, batches)
    known = [m._replace(rated=m.rated & valid) for _, m, valid in rows]
    kinds = {kind: measure([m for name, m, _ in rows if name == kind]) for kind in sorted({kind for kind, *_ in rows})}
    return measure([m for _, m, _ in rows]) | {"known": measure(known), "kinds": kinds}


@torch.no_grad()
def confidence(net: TraversabilityNet, batches: list[MappedTerrain]) -> dict[str, float | None]:
    """Return whether a net's confidence says how often it is right, for all rated cells and for unknown ones."""
    confident, right, known = [], [], []
    for maps in batches:
        rating = net(*maps.maps, resolution=maps.resolution, robot=maps.robot)
        confident.append(rating.confidence[maps.rated].double().numpy())
        agrees = (rating.traversability >= SAFE) == (maps.label >= SAFE)
        right.append(agrees[maps.rated].double().numpy())
        known.append(maps.validity[maps.rated].numpy())
    p, y, seen = (np.concatenate(parts) for parts in (confident, right, known))
    parts = {"known": seen, "unknown": ~seen}
    means = {f"{name}_{where}": _mean(values[mask]) for where, mask in parts.items() for name, values in
             (("confidence", p), ("right", y))}  # fmt: skip
    return {"calibration_error": calibration_error(p, y)} | means


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


def evaluate(
    nets: dict[str, TraversabilityNet],
    data: Path,
    num_batches: int,
    cfg: DataConfig | None = None,
    paper_weights: Path | None = None,
) -> dict[str, Any]:
    """Measure nets and baselines on ground that training never sees: result[split][resolution][head][metric].

    The maps are made, or read from the folder `data`; "held_out_exact" are of the true heights. A net's name becomes
    "learned (name)".
    """
    cfg = cfg or DataConfig()
    scores = {f"learned ({name})": learned(net) for name, net in nets.items()} | baselines(paper_weights)
    result: dict[str, Any] = {}
    for split, kinds in SPLITS.items():
        result[split] = {}
        for resolution in RESOLUTIONS:
            batches = data_set(data, split, num_batches, EVALUATION_SEED, cfg, kinds, resolution)
            bar = tqdm(scores.items(), desc=f"{split}, {100 * resolution:g} cm", unit="head")
            here = {name: metrics(score(head, batches), batches) for name, head in bar}
            for name, net in nets.items():
                here[f"learned ({name})"]["confidence"] = confidence(net, batches)
            result[split][f"{100 * resolution:g} cm"] = here
    robot = None if cfg.robot is None else dataclasses.asdict(cfg.robot)
    settings = {"batches": num_batches, "maps_of_a_batch": cfg.num_maps, "robot": robot, "seed": EVALUATION_SEED}
    return {"config": settings} | result


def best_of(heads: dict[str, Any], name: str) -> str:
    """Return the variant of a family with the highest average precision."""
    return max((head for head in heads if family(head) == name), key=lambda head: heads[head]["average_precision"] or 0)


def table(result: dict[str, Any], split: str = "held_out") -> str:
    """Tabulate each family of heads: learned ones by mean, lowest and highest over seeds, others by the best variant.

    The best is that of the highest average precision at that resolution.
    """
    lines = []
    for resolution, heads in result[split].items():
        for name in dict.fromkeys(family(head) for head in heads):
            variant = best_of(heads, name)
            runs = [values for head, values in heads.items() if family(head) == name] if name == "learned" else []
            cells = [_cell([run[column] for run in runs or [heads[variant]]]) for column in COLUMNS]
            lines.append([resolution, name if runs else variant, *cells])
    return markdown_table(["cells", "head", *COLUMNS.values()], lines)


def _cell(values: list[float | None]) -> str:
    numbers = [value for value in values if value is not None]
    if not numbers:
        return ""
    mean = f"{sum(numbers) / len(numbers):.3f}"
    return mean if len(numbers) == 1 else f"{mean} ({min(numbers):.3f} to {max(numbers):.3f})"


@click.command()
@click.option("--weights", "paths", type=click.Path(path_type=Path), multiple=True, help="Of several seeds: repeat it.")
@click.option("--data", type=click.Path(path_type=Path), default=Path("runs/traversability/data"), show_default=True)
@click.option("--batches", type=click.IntRange(1), default=20, show_default=True, help="At each resolution and split.")
@click.option("--robot", type=RobotType(), default=None, help="length=0.7,width=0.4,... or a YAML file. Default: any.")
@click.option("--paper-weights", type=click.Path(path_type=Path, exists=True), default=None, help="A file (npz).")
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs/traversability/evaluation.json"))
def main(
    paths: tuple[Path, ...], data: Path, batches: int, robot: RobotConfig | None, paper_weights: Path | None, out: Path
) -> None:
    """Measure learned heads beside the analytic ones, and the paper's filter if a file of its weights is given.

    Without --weights, those shipped with the package.
    """
    try:
        nets = {path.parent.name or path.stem: TraversabilityNet.from_pretrained(path) for path in paths}
        nets = nets or {"shipped": TraversabilityNet.from_pretrained()}
        result = evaluate(nets, data, batches, DataConfig(robot=robot), paper_weights)
    except (ValueError, OSError) as error:
        raise click.UsageError(str(error)) from None
    write_json(out, result)
    for split in SPLITS:
        click.echo(f"\n{split}\n\n{table(result, split)}")


if __name__ == "__main__":
    main()
