"""An exported policy that acts differently is refused."""

import pytest

import training.nav.export as nav_export
from tests.training.nav.runners import make_runner


@pytest.mark.slow(1)
def test_an_export_that_acts_otherwise_is_refused(tmp_path):
    runner = make_runner(tmp_path, "blind")
    nav_export.export(runner, tmp_path)
    assert not (tmp_path / "policy.onnx.data").exists(), "policy.onnx holds its weights"
    with pytest.raises(ValueError, match="policy.pt: must act as the policy does, got an error of 0"):
        nav_export.export(runner, tmp_path, tolerance=0.0)
