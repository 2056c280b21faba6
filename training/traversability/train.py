"""The command that trains the learned traversability head: `python -m training.traversability`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from torchelev.robot import RobotConfig
from training.options import paper_weights_option, smoke_option
from training.resume import checkpoint_path, command_errors, write_result
from training.traversability.evaluate import Maps, evaluate, table
from training.traversability.heads import baselines
from training.traversability.maps.data import data_set
from training.traversability.maps.mapping import DataConfig
from training.traversability.maps.terrain import KINDS
from training.traversability.picture import PICTURED_HEADS, picture
from training.traversability.robot import RobotType
from training.traversability.trainer import FitConfig, Trainer

_POSITIVE = click.IntRange(1)


@click.command()
@click.option(
    "--robot", type=RobotType(), default=None, help="length=0.7,width=0.4,... or a YAML file. Default: any robot."
)
@click.option("--seed", default=0, show_default=True, help="Seed of data, initial weights and order.")
@click.option(
    "--batches", type=_POSITIVE, default=300, show_default=True, help="Training batches of two maps from sensors."
)
@click.option(
    "--exact-batches", type=_POSITIVE, default=100, show_default=True, help="Further batches of the true heights."
)
@click.option(
    "--steps", type=_POSITIVE, default=4000, show_default=True, help="Steps in total, including those before --resume."
)
@click.option(
    "--evaluation-batches", type=_POSITIVE, default=20, show_default=True, help="Evaluation batches per resolution."
)
@paper_weights_option
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("runs/traversability"),
    show_default=True,
    help="Output folder.",
)
@click.option("--data", type=click.Path(path_type=Path), default=None, help="Folder of the maps. Default: OUT/data.")
@smoke_option(batches=1, exact_batches=1, steps=4, evaluation_batches=1)
@click.option("--resume", is_flag=True, help="Continue from OUT/checkpoint.pt.")
@click.pass_obj
def main(
    made: Maps | None,
    robot: RobotConfig | None,
    seed: int,
    batches: int,
    exact_batches: int,
    steps: int,
    evaluation_batches: int,
    paper_weights: Path | None,
    out: Path,
    data: Path | None,
    resume: bool,
) -> None:
    """Train the learned traversability head.

    Makes maps of simulated ground, labels their cells by where the robot can stand on the true ground, fits the head
    and evaluates it on held-out ground. Without --robot, the weights are for robots of 0.4 to 1.0 m length.

    Writes TensorBoard logs, checkpoint.pt, weights.pt (for `TraversabilityNet.from_pretrained`), result.json and
    maps.png to OUT. The maps are kept for the next training.
    """
    checkpoint = checkpoint_path(out, resume)
    made = made or Maps()
    cfg, data = made.config(robot=robot), data or out / "data"
    with command_errors():
        baselines(paper_weights)  # raises now, not after the training, if the file cannot be read
        maps = data_set(data, "train", batches, seed, cfg) + data_set(data, "train_exact", exact_batches, seed, cfg)
        trainer = Trainer(maps, FitConfig(steps=steps, seed=seed), robot)
        if resume:
            trainer.resume(checkpoint)
        trainer.run(out)
    _finish(trainer, cfg, out, data, evaluation_batches, paper_weights, made.resolutions)


def _finish(
    trainer: Trainer,
    cfg: DataConfig,
    out: Path,
    data: Path,
    num_batches: int,
    paper_weights: Path | None,
    resolutions: Sequence[float],
) -> None:
    """Save the weights, evaluate them and draw some maps."""
    net = trainer.net.eval()
    net.save(out / "weights.pt")
    result = evaluate({out.name: net}, data, num_batches, cfg, paper_weights, resolutions)
    write_result(out / "result.json", {"training": trainer.settings, **result})
    click.echo(table(result))
    others = {name: score for name, score in baselines(paper_weights).items() if name in PICTURED_HEADS}
    held_out = data_set(data, "held_out", num_batches, 0, cfg, KINDS, 0.04)
    picture(net, others, held_out, out / "maps.png")
    click.echo(f"Wrote weights.pt, result.json and maps.png to {out}.")
