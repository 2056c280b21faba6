"""Train the completion network with three seeds and compare them with U-Nets and with filters.

    python -m training.completion.experiment

Each seed draws its own initial weights and cells; the walks are the same. All answers are measured on the same held-out
ground, and on a kind of ground never trained on. Finished trainings are kept in RUNS: after Ctrl-C, run the command
again. Writes training/results/completion.json and prints the tables.
"""

from __future__ import annotations

from pathlib import Path

import click
import torch

from torchelev.app.results import write_json
from torchelev.completion.net import CompletionNet
from training import RESULTS
from training.completion.evaluate import COMPLETED, Answer, evaluate, learned, table
from training.completion.maps import YARD_CONFIG, TrueMap, WalkConfig, Walks, make_walks
from training.completion.unet import UNet, fit
from training.fit import save_atomically
from training.jobs import Job, train_all
from training.options import jobs_option, runs_option

# Fixed before the first run.
SEEDS = (0, 1, 2)
WALKS, DRIVES, COLLAGES, STEPS, EVALUATION_WALKS = 290, 130, 150, 15000, 32
UNETS = {"U-Net of equal size": 3}  # channels of the finest level
UNET_STEPS = 4000


def _jobs(runs: Path) -> list[Job]:
    """Return a training for each seed."""
    fixed = {"--data": runs / "data", "--walks": WALKS, "--drives": DRIVES, "--collages": COLLAGES}
    fixed |= {"--steps": STEPS, "--evaluation-walks": 1, "--jobs": 1}  # the evaluation of all is below
    return [Job("training.completion", {"--seed": seed, **fixed}, runs / f"seed-{seed}") for seed in SEEDS]


def _walks(runs: Path) -> list[tuple[Walks, int]]:
    """Return the walks, drives and collages of the trainings, and their numbers."""
    return [
        (Walks(runs / "data", "train", 0, WalkConfig()), WALKS),
        (Walks(runs / "data", "yards", 0, YARD_CONFIG), DRIVES),
        (Walks(runs / "data", "collages", 0, WalkConfig()), COLLAGES),
    ]


def fit_unet(runs: Path, channels: int) -> UNet:
    """Return a U-Net: the one in RUNS, or one that is fitted now."""
    path = runs / f"unet-{channels}.pt"
    if path.exists():
        net = UNet(channels)
        net.load_state_dict(torch.load(path, weights_only=True))
        return net.eval()
    maps: list[TrueMap] = [m for walks, count in _walks(runs) for index in range(count) for m in walks.read(index)]
    net = fit(maps, channels, UNET_STEPS)
    save_atomically(net.state_dict(), path)
    return net


def as_answer(net: UNet) -> Answer:
    """Return a U-Net as an answer."""
    return lambda maps: (torch.where(maps.layers.validity, maps.layers.elevation, net(maps)), None)


@click.command(help=__doc__)
@runs_option("runs/completion_experiment")
@jobs_option
def main(runs: Path, jobs: int) -> None:
    """Train, evaluate, write JSON and print the table."""
    for walks, count in _walks(runs):
        make_walks(walks, count, jobs)
    train_all(_jobs(runs), jobs)
    nets = {seed: CompletionNet.from_pretrained(runs / f"seed-{seed}" / "weights.pt") for seed in SEEDS}
    answers = {COMPLETED if seed == SEEDS[0] else f"seed {seed}": learned(net) for seed, net in nets.items()}
    answers |= {name: as_answer(fit_unet(runs, channels)) for name, channels in UNETS.items()}
    result = evaluate(answers, runs / "data", EVALUATION_WALKS, jobs)
    fixed = {
        "seeds": SEEDS,
        "walks": WALKS,
        "drives": DRIVES,
        "collages": COLLAGES,
        "steps": STEPS,
        "unet_steps": UNET_STEPS,
    }
    fixed |= {"evaluation_walks": EVALUATION_WALKS}
    write_json(RESULTS / "completion.json", result | {"training": fixed})
    click.echo(table(result))


if __name__ == "__main__":
    main()
