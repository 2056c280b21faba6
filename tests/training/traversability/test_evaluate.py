"""Evaluation: heads, subsets and kinds, and its table."""

import json

import pytest
import torch

import training.traversability.evaluate as evaluation
from tests.training.traversability.small import TINY, made_up
from torchelev.traversability.net import Rating, TraversabilityNet
from training.traversability.maps.data import make_batch


@pytest.mark.slow(2)
def test_evaluation_names_heads_subsets_and_kinds(tmp_path):
    torch.manual_seed(0)
    nets = {"0": TraversabilityNet(), "1": TraversabilityNet()}
    result = evaluation.evaluate(nets, tmp_path, 1, TINY(), resolutions=(0.08,))
    batch = make_batch([1, 0, 0], TINY(), resolution=0.08)
    heads = result["held_out"]["8 cm"]
    assert len(heads) == 2 + 8 and list(heads)[:2] == ["learned (0)", "learned (1)"]
    for values in heads.values():
        assert values["cells"] == int(batch.rated.sum())
        assert values["known"]["cells"] == int((batch.rated & batch.validity).sum())
        assert set(values["kinds"]) == set(batch.kinds)
        assert sum(kind["cells"] for kind in values["kinds"].values()) == values["cells"]
    assert set(result["unseen"]["8 cm"]["learned (0)"]["kinds"]) == {"stepping_stones"}
    assert 0 <= heads["learned (0)"]["confidence"]["calibration_error"] <= 1
    assert "confidence" not in heads["analytic (defaults)"]
    json.loads(json.dumps(result), parse_constant=pytest.fail)


def test_known_cells_are_those_that_are_rated_too():
    maps = made_up(0)
    found = evaluation.metrics([torch.full_like(maps.label, 0.7)], [maps])
    assert found["cells"] == int(maps.rated.sum()) and found["known"]["cells"] == int(
        (maps.rated & maps.validity).sum()
    )


def test_confidence_is_measured_where_the_ground_is_known_and_where_not():
    class Constant:
        def __call__(self, elevation, *layers, **of):
            return Rating(torch.full_like(elevation, 0.9), torch.full_like(elevation, 0.75))

    maps = made_up(0)
    found = evaluation.confidence(Constant(), [maps])
    safe = maps.label >= 0.5
    for name, where in (("known", maps.validity), ("unknown", ~maps.validity)):
        assert found[f"confidence_{name}"] == 0.75
        assert found[f"right_{name}"] == pytest.approx(float(safe[maps.rated & where].float().mean()))
    assert found["calibration_error"] == pytest.approx(abs(0.75 - float(safe[maps.rated].float().mean())))


def head(precision, **others):
    return dict.fromkeys(evaluation.COLUMNS, 0.5) | {"average_precision": precision} | others


def test_the_table_has_seeds_as_a_range_and_of_others_the_best():
    heads = {
        "learned (0)": head(0.8),
        "learned (1)": head(0.9, roc_auc=None),
        "analytic (defaults)": head(0.4),
        "analytic (defaults, footprint)": head(0.6),
    }
    lines = evaluation.table({"held_out": {"2 cm": heads}}).splitlines()
    assert lines[2].startswith("| 2 cm | learned | 0.850 (0.800 to 0.900) | 0.500 (0.500 to 0.500) | 0.500 |")
    assert lines[3].startswith("| 2 cm | analytic (defaults, footprint) | 0.600 |") and len(lines) == 4
