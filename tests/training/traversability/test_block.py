"""The profiles of the heads over a sharp step are compared with the truth."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from training.traversability import block


@pytest.mark.slow(1)
def test_beside_a_block_heads_are_compared_with_the_truth(tmp_path):
    options = ["--heights", "0.05", "--heights", "0.4", "--out", str(tmp_path)]
    assert CliRunner().invoke(block.main, options).exit_code == 0
    low, high = json.loads((tmp_path / "block.json").read_text())["profiles"]
    assert (tmp_path / "block.png").stat().st_size > 5000
    before, label = np.array(high["x"]), np.array(high["label"])
    assert min(low["label"]) == 1 and (label[before < -0.6] == 1).all()
    assert (label[np.abs(before) < 0.1] == 0).all() and len(label) == len(high["learned"]) == len(high["analytic"])
    wrong = {"height": 0.4, "label": [0.0, 0.0, 1.0, 1.0], "learned": [0.5, 0.1, 1.0, 0.8]}
    assert block.row(wrong, "learned") == ["40 cm", "learned", "0.20", "0.30", "1 of 2"]
