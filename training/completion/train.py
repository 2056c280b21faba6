"""The command that trains the completion network: `python -m training.completion`."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import click
import torch
import torch.nn.functional as F
from tqdm import tqdm

from training.completion.cells import (
    MeasuredCells,
    UnknownCells,
    concatenate,
    draw_evenly,
    draw_measured,
    draw_unknown,
    remove_cells,
    thin_out,
    vary_bounds,
)
from training.completion.evaluate import COMPLETED, SPLITS, Splits, evaluate, learned, table
from training.completion.maps import YARD_CONFIG, TrueMap, WalkConfig, Walks, make_walks
from training.completion.trainer import FitConfig, Trainer
from training.options import jobs_option, smoke_option
from training.resume import checkpoint_path, command_errors, write_result

_POSITIVE = click.IntRange(1)
_WALKS_SEED = 0


class Ground(NamedTuple):
    """Where the robots of a training walk and drive, and what it is evaluated on."""

    walks: WalkConfig = WalkConfig()
    yards: WalkConfig = YARD_CONFIG
    splits: Splits = SPLITS


@click.command()
@click.option(
    "--seed", default=0, show_default=True, help="Seed of initial weights and drawn cells; the walks stay the same."
)
@click.option("--walks", type=_POSITIVE, default=290, show_default=True, help="Training walks of four robots.")
@click.option("--drives", type=_POSITIVE, default=130, show_default=True, help="Training drives of four vehicles.")
@click.option("--collages", type=_POSITIVE, default=150, show_default=True, help="Training walks over collages.")
@click.option(
    "--steps", type=_POSITIVE, default=15000, show_default=True, help="Steps in total, including those before --resume."
)
@click.option(
    "--evaluation-walks", type=_POSITIVE, default=10, show_default=True, help="Evaluation walks per resolution."
)
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("runs/completion"), show_default=True, help="Output folder."
)
@click.option("--data", type=click.Path(path_type=Path), default=None, help="Folder of the walks. Default: OUT/data.")
@jobs_option
@smoke_option(walks=1, drives=1, collages=1, steps=4, evaluation_walks=1)
@click.option("--resume", is_flag=True, help="Continue from OUT/checkpoint.pt.")
@click.pass_obj
def main(
    ground: Ground | None,
    seed: int,
    walks: int,
    drives: int,
    collages: int,
    steps: int,
    evaluation_walks: int,
    out: Path,
    data: Path | None,
    jobs: int,
    resume: bool,
) -> None:
    """Train the completion network.

    Lets simulated robots walk over random ground of known kinds and over collages of random shapes, and vehicles drive
    through yards, and map it; fits the network to the true ground below unknown and measured cells, calibrates its
    standard deviations and evaluates it on held-out ground.

    Writes TensorBoard logs, checkpoint.pt, weights.pt (for `CompletionNet.from_pretrained`) and result.json to OUT. The
    walks are kept for the next training.
    """
    ground = ground or Ground()
    checkpoint = checkpoint_path(out, resume)
    data = data or out / "data"
    with command_errors():
        sets = [(Walks(data, "train", _WALKS_SEED, ground.walks), walks)]
        sets += [(Walks(data, "yards", _WALKS_SEED, ground.yards), drives)]
        sets += [(Walks(data, "collages", _WALKS_SEED, ground.walks), collages)]
        cells = training_cells(sets, jobs, seed)
        trainer = Trainer(*cells, FitConfig(steps=steps, seed=seed))
        if resume:
            trainer.resume(checkpoint)
        trainer.run(out)
        net = trainer.net.eval()
        net.save(out / "weights.pt")
        result = evaluate({COMPLETED: learned(net)}, data, evaluation_walks, jobs, ground.splits)
    write_result(out / "result.json", {"training": trainer.settings, **result})
    click.echo(table(result))
    click.echo(f"Wrote weights.pt and result.json to {out}.")


def training_cells(
    sets: list[tuple[Walks, int]], jobs: int, seed: int
) -> tuple[UnknownCells, MeasuredCells, UnknownCells]:
    """Return the cells of some walks of each set, which are made where they are missing.

    The third are unknown cells to calibrate with: of the maps as they were, evenly drawn.
    """
    unknown: list[UnknownCells] = []
    even: list[UnknownCells] = []
    measured: list[MeasuredCells] = []
    generator = torch.Generator().manual_seed(seed)
    for walks, count in sets:
        make_walks(walks, count, jobs)
        before: list[TrueMap] = []
        for index in tqdm(range(count), desc=f"cells of {walks.name}", unit="walk"):
            maps = walks.read(index)
            even += [cells for entry in maps for cells in draw_evenly(entry, generator)]
            thinned = [entry._replace(layers=thin_out(entry.layers, generator)) for entry in maps[-1:]]
            for view in [*maps, *_as_seen_before(maps[-1], before), *thinned]:
                varied = view._replace(layers=vary_bounds(view.layers, generator))
                unknown += draw_unknown(varied, generator)
                measured += draw_measured(varied, generator)
            before = maps
    return concatenate(unknown), concatenate(measured), concatenate(even)


def _as_seen_before(maps: TrueMap, before: list[TrueMap]) -> list[TrueMap]:
    """Return the maps without the cells that another walk's first view had not seen, if there is one."""
    size = maps.layers.validity.shape[1:]
    seen = [
        F.interpolate(other.layers.validity[:, None].float(), size, mode="nearest")[:, 0] > 0 for other in before[:1]
    ]
    return [maps._replace(layers=remove_cells(maps.layers, kept)) for kept in seen]
