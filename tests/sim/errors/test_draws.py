"""Values are drawn from their ranges at reset, for each environment alone, and repeat from a seed."""

import copy
import math

import pytest
import torch

from tests.sim.errors.error_cases import LIVELY, assert_mean, assert_share, assert_sigma, poses, rays
from torchelev.sim.errors.error_models import SensorErrorConfig, SensorErrors


def test_values_are_drawn_from_their_ranges_and_stay_until_reset():
    errors = SensorErrors(LIVELY, 20_000)
    before = errors.values.clone()
    dropout = errors.value("dropout")
    assert float(dropout.min()) >= 0.0 and float(dropout.max()) <= 0.3
    assert_mean(dropout, 0.15, 0.3 / math.sqrt(12))
    assert torch.equal(errors.value("too_long"), torch.full((20_000,), 0.05))
    errors(torch.ones(20_000, 1, 3), poses(20_000))
    assert torch.equal(errors.values, before)
    errors.reset()
    assert bool((errors.value("dropout") != before[:, errors.names.index("dropout")]).all())


def test_each_environment_gets_its_own_errors():
    got = SensorErrors(SensorErrorConfig(range_constant=(0.0, 0.1)), 3)(rays(3, 20_000, 2.0)).points
    errors = SensorErrors(SensorErrorConfig(range_constant=(0.0, 0.1)), 3)
    for b in range(3):
        assert_sigma(got[b].norm(dim=-1) - 2.0, float(errors.value("range_constant")[b]))


@pytest.mark.parametrize("how", ["ids", "mask"])
def test_reset_touches_the_given_environments_alone(how):
    errors, other = SensorErrors(LIVELY, 6), SensorErrors(LIVELY, 6)
    before, mounted = errors.values.clone(), errors.mounting()
    if how == "ids":
        errors.reset(torch.tensor([1, 4]))
    else:
        errors.reset(mask=torch.tensor([False, True, False, False, True, False]))
    kept = torch.tensor([0, 2, 3, 5])
    assert torch.equal(errors.values[kept], before[kept]) and torch.equal(errors.mounting()[kept], mounted[kept])
    assert bool((errors.value("dropout")[[1, 4]] != before[[1, 4], errors.names.index("dropout")]).all())
    assert bool((errors.mounting()[[1, 4], 0, 3] != mounted[[1, 4], 0, 3]).all())
    other.reset()  # who else resets makes no difference
    assert torch.equal(other.values[[1, 4]], errors.values[[1, 4]])


def test_the_same_seed_gives_the_same_errors_to_the_bit():
    def run(seed):
        errors = SensorErrors(LIVELY, 3, seed=seed)
        first = [errors(rays(3, 60), poses(3, k), image_shape=(6, 10)).points for k in range(5)]
        errors.reset(torch.tensor([1]))
        return torch.stack([*first, errors(rays(3, 60), poses(3), image_shape=(6, 10)).points]).nan_to_num(9.0)

    assert torch.equal(run(4), run(4))
    assert not torch.equal(run(4), run(5))


def test_kinds_of_episodes_come_by_their_shares():
    config = SensorErrorConfig
    kinds = [(0.6, config(dropout=0.1)), (0.3, config(dropout=(0.2, 0.3))), (0.1, config())]
    dropout = SensorErrors(kinds, 20_000).value("dropout")
    assert_share(dropout == 0.1, 0.6)
    assert_share(dropout == 0.0, 0.1)
    offset = dropout[(dropout >= 0.2) & (dropout <= 0.3)]
    assert len(offset) == int(((dropout != 0.1) & (dropout != 0.0)).sum())
    assert_mean(offset, 0.25, 0.1 / math.sqrt(12))


def test_copies_go_on_alike():
    errors = SensorErrors(LIVELY, 2)
    other = copy.deepcopy(errors)
    one, two = (e(rays(2, 30), poses(2)).points for e in (errors, other))
    torch.testing.assert_close(one, two, atol=0, rtol=0, equal_nan=True)


def test_bad_kinds_and_numbers_are_refused():
    with pytest.raises(ValueError, match="sum to 1"):
        SensorErrors([(0.6, SensorErrorConfig())], 1)
    with pytest.raises(TypeError, match="SensorErrorConfig"):
        SensorErrors({"dropout": 0.1}, 1)
    with pytest.raises(TypeError, match="pairs"):
        SensorErrors([SensorErrorConfig()], 1)
    with pytest.raises(ValueError, match="num_envs"):
        SensorErrors(SensorErrorConfig(), 0)
