"""The command: it trains, evaluates, draws, resumes, and refuses what does not fit."""

import json

import pytest
import torch
from click.testing import CliRunner

import training.traversability.evaluate as evaluation
import training.traversability.train as training
from tests.training.traversability.small import TINY
from training.resume import CHECKPOINT


def invoke(main, *arguments):
    maps = evaluation.Maps(TINY, (0.08,))
    return CliRunner().invoke(main, [*map(str, arguments)], obj=maps, catch_exceptions=False)


@pytest.mark.slow(6)
def test_the_commands_train_evaluate_draw_and_resume(tmp_path):
    """For one robot."""
    out, robot = tmp_path / "run", ("--robot", "length=0.5,width=0.45,foot_radius=0.1")
    common = ("--out", out, "--batches", 1, "--exact-batches", 1, "--evaluation-batches", 1, *robot, "--steps", 2)
    done = invoke(training.main, *common)
    assert done.exit_code == 0 and "| 8 cm | learned |" in done.output
    result = json.loads((out / "result.json").read_text(), parse_constant=pytest.fail)
    assert result["training"]["steps"] == 2 and result["held_out"]["8 cm"]["learned (run)"]["cells"] > 100
    assert (out / "maps.png").stat().st_size > 5000
    refused = invoke(training.main, *common)
    assert refused.exit_code == 2 and "add --resume" in refused.output
    assert invoke(training.main, *common, "--resume").exit_code == 0, "nothing left: it only evaluates"
    other = invoke(training.main, *common[:-1], 3, "--resume")
    assert other.exit_code == 2 and "must be of the same settings, got steps 2" in other.output

    any_robot = invoke(training.main, *common[:8], *common[-2:], "--resume", "--data", tmp_path / "other")
    assert any_robot.exit_code == 2 and "must be of the same settings" in any_robot.output
    found = torch.load(out / CHECKPOINT, weights_only=True)["settings"]["robot"]
    assert (found["length"], found["width"], found["foot_radius"]) == (0.5, 0.45, 0.1)

    options = (*robot, "--data", out / "data", "--batches", 1, "--out", tmp_path / "evaluation.json")
    again = invoke(evaluation.main, "--weights", out / "weights.pt", *options)
    assert again.exit_code == 0 and "unseen" in again.output
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert found["held_out"]["8 cm"]["learned (run)"] == result["held_out"]["8 cm"]["learned (run)"]


def test_the_command_refuses_what_does_not_fit(tmp_path):
    missing = invoke(training.main, "--out", tmp_path / "nowhere", "--resume")
    assert missing.exit_code == 2 and "leave --resume out" in missing.output
    assert "there is no legs" in invoke(training.main, "--robot", "legs=4", "--out", tmp_path).output
    for option in ("--steps", "--batches", "--evaluation-batches"):
        assert option in invoke(training.main, option, 0).output
    nothing = invoke(evaluation.main, "--weights", tmp_path / "none.pt", "--data", tmp_path)
    assert nothing.exit_code == 2 and "none.pt" in nothing.output
