"""Compare learned traversability heads with the analytic ones on held-out ground.

    python -m training.traversability.evaluate --weights weights.pt

Without --weights, the shipped weights are evaluated. With --paper-weights, the paper's filter takes part.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchelev.app.results import markdown_table, write_json
from torchelev.robot import RobotConfig
from torchelev.traversability.net import TraversabilityNet
from training.options import paper_weights_option
from training.traversability.heads import Score, baselines, family
from training.traversability.maps.data import MappedTerrain, data_set
from training.traversability.maps.mapping import DataConfig
from training.traversability.maps.terrain import KINDS, UNSEEN_KINDS
from training.traversability.metrics import SAFE, RatedMap, calibration_error, measure
from training.traversability.robot import RobotType

RESOLUTIONS = (0.02, 0.04, 0.08)  # [m]


class Maps(NamedTuple):
    """How maps are made, and their resolutions when heads are evaluated [m]."""

    config: Callable[..., DataConfig] = DataConfig
    resolutions: Sequence[float] = RESOLUTIONS


SPLITS = {"held_out": KINDS, "unseen": UNSEEN_KINDS, "held_out_exact": KINDS}
_EVALUATION_SEED = 0  # of the maps, the same for all weights
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


def learned(net: TraversabilityNet) -> Score:
    """Return a net's traversability as a score."""
    return lambda maps: net(*maps.maps, resolution=maps.resolution, robot=maps.robot).traversability


@torch.no_grad()
def score(head: Score, batches: list[MappedTerrain]) -> list[Tensor]:
    """Return the scores of each batch (B, H, W)."""
    return [head(maps) for maps in batches]


def _split(scores: list[Tensor], batches: list[MappedTerrain]) -> list[tuple[str, RatedMap, np.ndarray]]:
    """Return for each map the kind of ground, its scores and labels, and which cells are known."""
    rows = []
    for values, maps in zip(scores, batches, strict=True):
        layers = zip(maps.kinds, values, maps.label, maps.rated, maps.validity, strict=True)
        for kind, value, label, rated, known in layers:
            rated_map = RatedMap(value.double().numpy(), label.numpy(), rated.numpy(), maps.resolution)
            rows.append((kind, rated_map, known.numpy()))
    return rows


def metrics(scores: list[Tensor], batches: list[MappedTerrain]) -> dict[str, Any]:
    """Return the metrics over all rated cells, over the known ones among them, and by kind of ground."""
    rows = _split(scores, batches)
    known = [m._replace(rated=m.rated & valid) for _, m, valid in rows]
    kinds = {kind: measure([m for name, m, _ in rows if name == kind]) for kind in sorted({kind for kind, *_ in rows})}
    return measure([m for _, m, _ in rows]) | {"known": measure(known), "kinds": kinds}


@torch.no_grad()
def confidence(net: TraversabilityNet, batches: list[MappedTerrain]) -> dict[str, float | None]:
    """Return mean confidence and fraction of correct answers, on known and unknown cells, and the calibration error."""
    confident, right, known = [], [], []
    for maps in batches:
        rating = net(*maps.maps, resolution=maps.resolution, robot=maps.robot)
        confident.append(rating.confidence[maps.rated].double().numpy())
        agrees = (rating.traversability >= SAFE) == (maps.label >= SAFE)
        right.append(agrees[maps.rated].double().numpy())
        known.append(maps.validity[maps.rated].numpy())
    p, y, is_known = (np.concatenate(parts) for parts in (confident, right, known))
    parts = {"known": is_known, "unknown": ~is_known}
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
    resolutions: Sequence[float] = RESOLUTIONS,
) -> dict[str, Any]:
    """Measure nets and baselines on held-out ground.

    Args:
        nets: by name; a name becomes "learned (name)".
        data: folder of the maps; missing ones are made.
        num_batches: number of batches for each split and resolution.
        cfg: how maps are made; None: the default.
        paper_weights: file of the paper's filter; None: it is left out.
        resolutions: of the maps [m].

    Returns:
        `result[split][resolution][head][metric]`, and the settings in `result["config"]`. The maps of the split
        "held_out_exact" are of the true heights.
    """
    cfg = cfg or DataConfig()
    scores = {f"learned ({name})": learned(net) for name, net in nets.items()} | baselines(paper_weights)
    result: dict[str, Any] = {}
    for split, kinds in SPLITS.items():
        result[split] = {}
        for resolution in resolutions:
            batches = data_set(data, split, num_batches, _EVALUATION_SEED, cfg, kinds, resolution)
            bar = tqdm(scores.items(), desc=f"{split}, {100 * resolution:g} cm", unit="head")
            here = {name: metrics(score(head, batches), batches) for name, head in bar}
            for name, net in nets.items():
                here[f"learned ({name})"]["confidence"] = confidence(net, batches)
            result[split][f"{100 * resolution:g} cm"] = here
    robot = None if cfg.robot is None else dataclasses.asdict(cfg.robot)
    settings = {"batches": num_batches, "maps_of_a_batch": cfg.num_maps, "robot": robot, "seed": _EVALUATION_SEED}
    return {"config": settings} | result


def _best_variant(heads: dict[str, Any], name: str) -> str:
    """Return the head of a family with the highest average precision."""
    return max((head for head in heads if family(head) == name), key=lambda head: heads[head]["average_precision"] or 0)


def table(result: dict[str, Any], split: str = "held_out") -> str:
    """Tabulate each family of heads.

    Learned heads: mean, lowest and highest over the seeds. Others: the variant with the highest average precision at
    that resolution.
    """
    lines = []
    for resolution, heads in result[split].items():
        for name in dict.fromkeys(family(head) for head in heads):
            variant = _best_variant(heads, name)
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


@click.command(help=__doc__)
@click.option(
    "--weights",
    "paths",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Weights to evaluate; repeat for several seeds.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    default=Path("runs/traversability/data"),
    show_default=True,
    help="Folder of the maps; missing ones are made.",
)
@click.option(
    "--batches", type=click.IntRange(1), default=20, show_default=True, help="Batches per resolution and split."
)
@click.option(
    "--robot", type=RobotType(), default=None, help="length=0.7,width=0.4,... or a YAML file. Default: any robot."
)
@paper_weights_option
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("runs/traversability/evaluation.json"),
    show_default=True,
    help="JSON file to write.",
)
@click.pass_obj
def main(
    maps: Maps | None,
    paths: tuple[Path, ...],
    data: Path,
    batches: int,
    robot: RobotConfig | None,
    paper_weights: Path | None,
    out: Path,
) -> None:
    """Evaluate, write JSON and print the tables."""
    maps = maps or Maps()
    try:
        nets = {path.parent.name or path.stem: TraversabilityNet.from_pretrained(path) for path in paths}
        nets = nets or {"shipped": TraversabilityNet.from_pretrained()}
        result = evaluate(nets, data, batches, maps.config(robot=robot), paper_weights, maps.resolutions)
    except (ValueError, OSError) as error:
        raise click.UsageError(str(error)) from None
    write_json(out, result)
    for split in SPLITS:
        click.echo(f"\n{split}\n\n{table(result, split)}")


if __name__ == "__main__":
    main()
