"""Time passes."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import nans, pose, random_state, small_map
from torchelev import AgingConfig, FusionConfig
from torchelev.stages.age import age


@given(st.integers(0, 10_000), st.floats(0, 5))
def test_agrees_with_the_reference(seed, rate):
    rng = np.random.default_rng(seed)
    emap = small_map(3, (5, 4), dtype=torch.float64)
    state = random_state(rng, emap.cfg.grid, 3)
    dt = torch.from_numpy(rng.uniform(0, 2, 3))
    m = emap.measure(nans(3), pose(num_envs=3), None, dt)
    after = age(state, m, AgingConfig(variance_rate=rate))
    for b in range(3):
        args = (state.variance[b].numpy(), state.time[b].numpy(), dt[b].item(), rate)
        variance, time = reference.age(*args)
        np.testing.assert_allclose(after.variance[b], variance, rtol=1e-12)
        np.testing.assert_allclose(after.time[b], time, rtol=1e-12)


def test_each_environment_has_its_own_dt():
    emap = small_map(2, aging=AgingConfig(variance_rate=0.01))
    emap.load_state(random_state(np.random.default_rng(0), emap.cfg.grid, 2, known=1.0))
    before = emap.layer("variance"), emap.layer("time")
    emap.update(nans(2), pose(num_envs=2), None, torch.tensor([0.0, 2.0]))
    grown, passed = emap.layer("variance") - before[0], emap.layer("time") - before[1]
    assert torch.equal(grown[0], torch.zeros_like(grown[0])) and torch.equal(passed[0], torch.zeros_like(passed[0]))
    torch.testing.assert_close(grown[1], torch.full_like(grown[1], 0.02))
    torch.testing.assert_close(passed[1], torch.full_like(passed[1], 2.0))


def test_the_variance_grows_to_its_maximum():
    emap = small_map(1, aging=AgingConfig(variance_rate=0.4), fusion=FusionConfig(max_variance=0.5))
    emap.load_state(random_state(np.random.default_rng(0), emap.cfg.grid, known=1.0))
    for _ in range(2):
        emap.update(nans(1), pose(), None, 1.0)
    assert (emap.layer("variance") == 0.5).all()


def test_refuses():
    with pytest.raises(ValueError, match="aging.variance_rate"):
        AgingConfig(variance_rate=-1.0)
