"""The comparison of encoders: its trainings, its table and its figure."""

import json

import pytest
import torch
from torch.utils.tensorboard import SummaryWriter

import training.nav.encoder_experiment as experiment
from training.nav.encoders import ENCODERS


class Answer(torch.nn.Module):
    """A policy that answers a number."""

    def __init__(self, number: float) -> None:
        super().__init__()
        self.register_buffer("number", torch.tensor(float(number)))

    def forward(self, policy: torch.Tensor, images: list[torch.Tensor]) -> torch.Tensor:
        return self.number + 0 * (policy.sum() + images[0].sum())


def make_folder(folder):
    folder.mkdir()
    return folder


def result():
    """Success 0.5 and 0.7 with the MLP, 0.6 and 0.8 with the CNN, 0.7 and 0.9 with attention."""
    rows = []
    for encoder, seed in experiment.CASES:
        success = 0.5 + 0.1 * ENCODERS.index(encoder) + 0.2 * seed
        deployed = {"success": success, "fallen": 1 - success, "stuck": 0.0, "truncated": 0.0}
        curve = {"steps": [100, 200], "success": [0.0, success]}
        training = {"steps": 6000, "seconds": 120.0}
        rows.append({"encoder": encoder, "seed": seed, "training": training, "deployed": deployed, "curve": curve})
    return {"config": {"seeds": list(experiment.SEEDS)}, "rows": rows}


def test_every_encoder_gets_the_same_training(tmp_path):
    jobs = experiment._jobs(tmp_path)
    assert len({job.folder for job in jobs}) == len(jobs) == len(ENCODERS) * len(experiment.SEEDS)
    others = [{name: value for name, value in job.arguments.items() if name != "--encoder"} for job in jobs]
    assert all(others.count(other) == len(ENCODERS) for other in others)


def test_the_table_has_the_mean_and_the_extremes():
    lines = experiment.table(result()).split("\n")
    assert lines[3] == "| CNN | 70.0 % (60.0 to 80.0) | 30 % | 0 % | 0 % |" and len(lines) == 5


@pytest.mark.slow(1)
def test_the_figure_is_drawn(tmp_path):
    experiment.plot(result(), tmp_path / "encoders.png")
    assert (tmp_path / "encoders.png").stat().st_size > 5000


def test_reads_every_policy_from_its_folder(tmp_path):
    deployed = []

    def evaluate(policy, *rest, **options):
        deployed.append(policy({"policy": torch.zeros(1), "map": torch.zeros(1)}).item())
        return deployed[-1]

    for number, (encoder, seed) in enumerate(experiment.CASES):
        folder = experiment._folder(tmp_path, encoder, seed)
        torch.jit.script(Answer(number)).save(make_folder(folder) / "policy.pt")
        with SummaryWriter(str(folder)) as log:
            log.add_scalar("/success", 0.25 * seed, 3)
        (folder / "result.json").write_text(json.dumps({"training": {"steps": 1, "seconds": seed}}))
    rows = experiment.deploy_all(tmp_path, evaluate)["rows"]
    assert [row["deployed"] for row in rows] == deployed == list(range(len(experiment.CASES)))
    assert [row["curve"]["success"] for row in rows] == [[0.25 * seed] for _, seed in experiment.CASES]
    assert [row["training"]["seconds"] for row in rows] == [seed for _, seed in experiment.CASES]
