"""The command: it trains, evaluates, draws, exports and resumes."""

import json

import pytest
import torch
from click.testing import CliRunner

import training.nav.train as nav
from tests.training.nav.runners import CFG


def invoke(*arguments):
    return CliRunner().invoke(
        nav.main, [*map(str, arguments), "--no-compile"], obj=lambda **_: CFG, catch_exceptions=False
    )


@pytest.mark.slow(10)
def test_the_command_resumes_evaluates_draws_and_exports(tmp_path):
    out = tmp_path / "run"
    common = ("--num-envs", 4, "--out", out, "--episodes", 4, "--perception", "map")
    runner = nav.make_runner(4, "map", 0, "cpu", out, compiled=False, config=lambda **_: CFG)
    runner.learn(2)  # the command's first training: test_fill_experiment.py
    runner.close()
    refused = invoke(*common)
    assert refused.exit_code == 2 and "add --resume" in refused.output
    assert invoke(*common, "--iterations", 3, "--resume").exit_code == 0
    result = json.loads((out / "result.json").read_text(), parse_constant=pytest.fail)
    ends = ("success", "fallen", "stuck", "truncated")
    assert sum(result["evaluation"][name] for name in ends) == pytest.approx(1.0)
    assert result["training"]["steps"] == 3 * 24 * 4 and result["evaluation"]["seconds"] is None, "nobody arrives"
    for name in ("episode.png", "policy.pt", "policy.onnx"):
        assert (out / name).stat().st_size > 1000
    assert "has 3 iterations already: only evaluating" in invoke(*common, "--iterations", 2, "--resume").output
    for option in ("--num-envs", "--iterations", "--episodes"):
        assert option in invoke(option, 0).output
    if not torch.cuda.is_available():
        assert "there is no GPU for cuda" in invoke("--device", "cuda").output
    missing = invoke("--out", tmp_path / "nowhere", "--resume")
    assert missing.exit_code == 2 and "leave --resume out" in missing.output
