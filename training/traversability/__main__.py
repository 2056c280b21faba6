"""Train the learned traversability head: `python -m training.traversability`, for a robot of any size or for yours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from torchelev.output_files import atomic_file
from torchelev.robot import RobotConfig
from training.traversability.evaluate import evaluate, table
from training.traversability.heads import baselines
from training.traversability.maps.data import data_set
from training.traversability.maps.mapping import DataConfig
from training.traversability.maps.terrain import KINDS
from training.traversability.picture import picture
from training.traversability.robot import RobotType
from training.traversability.trainer import CHECKPOINT, FitConfig, Trainer

POSITIVE = click.IntRange(1)
SHOWN = ("analytic (defaults)", "paper (at 4 cm)")  # in the picture


@click.command()
@click.option("--robot", type=RobotType(), default=None, help="length=0.7,width=0.4,... or a YAML file. Default: any.")
@click.option("--seed", default=0, show_default=True, help="Of data, first weights and order.")
@click.option("--batches", type=POSITIVE, default=300, show_default=True, help="Of two maps by sensors, to train on.")
@click.option("--exact-batches", type=POSITIVE, default=100, show_default=True, help="More, of the true heights.")
@click.option("--steps", type=POSITIVE, default=4000, show_default=True, help="In all, those of --resume included.")
@click.option("--evaluation-batches", type=POSITIVE, default=20, show_default=True, help="At each resolution.")
@click.option("--paper-weights", type=click.Path(path_type=Path, exists=True), default=None, help="To compare with.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs/traversability"), show_default=True)
@click.option("--data", type=click.Path(path_type=Path), default=None, help="Where maps are kept. Default: OUT/data.")
@click.option("--resume", is_flag=True, help="Go on from OUT/checkpoint.pt.")
def main(
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
    """Make maps, label them by where the robot stands on the true ground, train, and evaluate on other ground.

    Without --robot, the weights are for robots of 0.4 to 1.0 m length. OUT receives TensorBoard logs, checkpoint.pt,
    weights.pt (for `TraversabilityNet.from_pretrained`), result.json and maps.png. Maps that are made are kept.
    """
    checkpoint = out / CHECKPOINT
    if resume and not checkpoint.exists():
        raise click.UsageError(f"--resume: there is no {checkpoint}; leave --resume out to begin")
    if not resume and checkpoint.exists():
        raise click.UsageError(f"--out: {out} holds a training; add --resume, or choose another folder")
    cfg, data = DataConfig(robot=robot), data or out / "data"
    try:
        baselines(paper_weights)  # a file that cannot be read is refused now, not after the training
        maps = data_set(data, "train", batches, seed, cfg) + data_set(data, "train_exact", exact_batches, seed, cfg)
        trainer = Trainer(maps, FitConfig(steps=steps, seed=seed), robot)
        if resume:
            trainer.resume(checkpoint)
        trainer.run(out)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    except KeyboardInterrupt:
        raise click.ClickException("stopped; what was done is kept, go on with --resume") from None
    finish(trainer, cfg, out, data, evaluation_batches, paper_weights)


def finish(
    trainer: Trainer, cfg: DataConfig, out: Path, data: Path, num_batches: int, paper_weights: Path | None
) -> dict[str, Any]:
    """Save the weights, evaluate them and draw some maps; return the evaluation."""
    net = trainer.net.eval()
    net.save(out / "weights.pt")
    result = evaluate({out.name: net}, data, num_batches, cfg, paper_weights)
    with atomic_file(out / "result.json") as file:
        file.write((json.dumps({"training": trainer.settings, **result}, indent=1) + "\n").encode())
    click.echo(table(result))
    others = {name: score for name, score in baselines(paper_weights).items() if name in SHOWN}
    held_out = data_set(data, "held_out", num_batches, 0, cfg, KINDS, 0.04)
    picture(net, others, held_out, out / "maps.png")
    click.echo(f"Wrote weights.pt, result.json and maps.png to {out}.")
    return result


if __name__ == "__main__":
    main()
