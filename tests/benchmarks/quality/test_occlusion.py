"""The scenes of the occlusion benchmark: what the camera sees of them, and what its scores mean."""

import pytest
import torch

from benchmarks.quality.occlusion import footholds, report, rules
from benchmarks.quality.occlusion.scenes import KINDS, curb, glass_wall, step_down, tall_grass
from benchmarks.quality.occlusion.walks import CONFIG
from torchelev import ElevationMap

ORIGIN = torch.tensor([-1.0, 0.0, 0.8])


@pytest.mark.slow(6)
@pytest.mark.parametrize("make", KINDS)
@pytest.mark.parametrize("u", [(0.0, 0.0), (1.0, 1.0)])
def test_who_knows_the_ground_is_right(make, u):
    case, emap = make(list(u)), ElevationMap(CONFIG)
    assert rules.decide(emap, -1.0, case)[rules.TRUTH].reached.item() == case.safe


def test_rays_end_within_the_grass():
    """Of 20 cm height, from x = 0 to 0.8 m; a mean free path of 30 cm."""
    ends = torch.stack([torch.linspace(0.1, 0.7, 4000), torch.zeros(4000), torch.zeros(4000)], -1)
    seen = tall_grass([0.0, 0.0]).disturb(ends, ORIGIN, torch.Generator().manual_seed(0))
    stopped = seen[:, 2] > 1e-3
    assert 0.4 < stopped.float().mean() < 0.8 and (seen[:, 2] <= 0.2 + 1e-5).all() and (seen[stopped, 0] >= 0).all()
    along = (seen - ORIGIN) / (ends - ORIGIN)
    torch.testing.assert_close(along[:, 0], along[:, 2])  # each ends on its own ray
    before = torch.tensor([[-0.5, 0.0, 0.0], [torch.nan] * 3])
    torch.testing.assert_close(
        tall_grass([0.0, 0.0]).disturb(before, ORIGIN, torch.Generator()), before, equal_nan=True
    )


def test_glass_returns_only_what_meets_it_straight():
    ahead = torch.tensor([[3.0, 0.1, 0.7], [1.0, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    seen = glass_wall([1.0, 0.0]).disturb(ahead, ORIGIN, torch.Generator())
    assert seen[0].tolist() == pytest.approx([0.0, 0.025, 0.775]) and torch.equal(seen[1:], ahead[1:])


def test_footholds_are_cells_close_behind_an_edge(monkeypatch):
    case, emap = step_down([0.5, 0.5]), ElevationMap(CONFIG)
    x, y = emap.cell_centers()[0, :, 0, 0], emap.cell_centers()[0, 0, :, 1]
    true = rules.true_heights(emap, case)
    monkeypatch.setattr(
        footholds, "predict", lambda emap, rule: (true + (0.02 if rule == "upper bound" else 0.04), True)
    )
    unknown, right = footholds.score(emap, case)
    assert unknown == int(((x > 0) & (x <= 0.3)).sum() * (y.abs() <= 0.5).sum()) == 8 * 26
    assert right.pop("upper bound") == unknown and not any(right.values())


def test_shares_are_of_each_kind():
    goes = {rule: [True] * 4 + [rule == rules.UPPER_BOUND] for rule in rules.RULES}
    trials = [
        report.Trial(make([0.5, 0.5]), goes, 10, dict.fromkeys(rules.PREDICTED, 5)) for make in (curb, glass_wall)
    ]
    right = report.decisions(trials)
    assert right[rules.UPPER_BOUND]["curb"]["all"] == 100 and right[rules.UPPER_BOUND]["curb"]["whole walk"] == 100
    assert right[rules.TRUTH]["curb"] == {"2.4 m": 100, "2.0 m": 100, "1.6 m": 100, "1.2 m": 100, "0.8 m": 0} | {
        "all": 80, "whole walk": 0
    }  # fmt: skip
    assert right[rules.TRUTH]["glass wall"]["all"] == 20 and right[rules.TRUTH]["glass wall"]["whole walk"] == 100
    assert report.footholds(trials)[rules.UPPER_BOUND] == {"curb": 50, "glass wall": 50, "all": 50}
