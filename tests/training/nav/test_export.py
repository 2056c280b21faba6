"""An exported policy that acts differently is refused."""

import pytest

import training.nav.export as nav_export
from tests.training.nav.runners import make_runner


@pytest.mark.slow(1)
def test_an_export_that_acts_otherwise_is_refused(tmp_path, monkeypatch):
    runner = make_runner(tmp_path, "blind")
    nav_export.export(runner, tmp_path)
    assert not (tmp_path / "policy.onnx.data").exists(), "policy.onnx holds its weights"
    run = nav_export.run_onnx
    monkeypatch.setattr(nav_export, "run_onnx", lambda path, observation: run(path, observation) + 0.01)
    with pytest.raises(ValueError, match="policy.onnx: must act as the policy does, got an error of 0.01"):
        nav_export.export(runner, tmp_path)
