"""Time passes."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import nans, pose, random_state, scan, small_map
from tests.kernels.compare import by_cpu, by_tensors, inputs_of, require_cpu_backend
from torchelev import AgingConfig, FusionConfig
from torchelev.stages.age.stage import age
from torchelev.stages.measure.stage import time_step


@given(st.integers(0, 10_000), st.floats(0, 5))
def test_agrees_with_the_reference(seed, rate):
    rng = np.random.default_rng(seed)
    emap = small_map(3, (5, 4), dtype=torch.float64)
    state = random_state(rng, emap.cfg.grid, 3)
    dt = torch.from_numpy(rng.uniform(0, 2, 3))
    m = emap.measure(nans(3), pose(num_envs=3), None, dt)
    max_variance = rng.uniform(0.5, 5)
    after = age(state, m, AgingConfig(variance_rate=rate), max_variance)
    for b in range(3):
        args = (state.variance[b].numpy(), state.time[b].numpy(), dt[b].item(), rate)
        variance, time = reference.age(*args)
        known = state.validity[b].numpy()
        limited = np.where(known, np.minimum(variance, max_variance), state.variance[b])
        np.testing.assert_allclose(after.variance[b], limited, rtol=1e-12)
        np.testing.assert_allclose(after.time[b], np.where(known, time, state.time[b]), rtol=1e-12)
        assert after.elapsed[b] == state.elapsed[b] + round(dt[b].item() * 1e9)


def test_each_environment_has_its_own_dt():
    emap = small_map(2, aging=AgingConfig(variance_rate=0.01))
    emap.load_state(random_state(np.random.default_rng(0), emap.cfg.grid, 2, known=1.0))
    before = emap.layer("variance"), emap.layer("time")
    emap.update(nans(2), pose(num_envs=2), None, torch.tensor([0.0, 2.0]))
    grown, passed = emap.layer("variance") - before[0], emap.layer("time") - before[1]
    assert torch.equal(grown[0], torch.zeros_like(grown[0])) and torch.equal(passed[0], torch.zeros_like(passed[0]))
    torch.testing.assert_close(grown[1], torch.full_like(grown[1], 0.02))
    torch.testing.assert_close(passed[1], torch.full_like(passed[1], 2.0))


def test_elapsed_sums_dt_per_environment_until_a_reset():
    emap = small_map(3)
    for dt in (0.5, torch.tensor([0.0, 0.25, 2.0]), 0.125):
        emap.update(nans(3), pose(num_envs=3), None, dt)
    assert emap.state.elapsed.tolist() == [625_000_000, 875_000_000, 2_625_000_000]
    emap.reset(torch.tensor([1]))
    assert emap.state.elapsed.tolist() == [625_000_000, 0, 2_625_000_000]
    emap.reset(mask=torch.tensor([True, False, False]))
    assert emap.state.elapsed.tolist() == [0, 0, 2_625_000_000]


def test_elapsed_has_no_rounding_errors_at_any_precision():
    """After a year, too, where a float32 counts in steps of two seconds."""
    emap = small_map(1)
    year = 365 * 86_400_000_000_000
    emap.state.elapsed.fill_(year)
    for _ in range(3):
        emap.update(nans(1), pose(), None, 0.02)
    step = round(float(torch.tensor(0.02)) * 1e9)  # of the map's dtype
    for dtype in (torch.float16, torch.bfloat16, torch.float64):
        assert emap.to(dtype).state.elapsed.tolist() == [year + 3 * step]


def test_no_time_passes_by_a_dt_that_is_not_finite_or_negative():
    emap = small_map(4)
    m = emap.measure(nans(4), pose(num_envs=4), None, 1.0)
    dt = time_step(torch.tensor([torch.nan, torch.inf, -torch.inf, -1.0]), torch.float32)
    assert not age(emap.state, m._replace(dt=dt), AgingConfig(), 1.0).elapsed.any()


def test_time_has_a_gradient_and_elapsed_has_none():
    emap = small_map(1)
    emap.load_state(random_state(np.random.default_rng(0), emap.cfg.grid, known=1.0))
    dt = torch.tensor([0.5], requires_grad=True)
    after = emap(emap.state, emap.measure(nans(1), pose(), None, dt))
    after.time.sum().backward()
    assert dt.grad.item() == after.time.numel()
    assert not after.elapsed.requires_grad and (after.elapsed - emap.state.elapsed).tolist() == [500_000_000]


def test_the_time_of_a_cells_last_hit_stays_until_it_is_hit_again():
    emap = small_map(2)
    cloud, T = scan(0)
    emap.update(nans(2), T, T, 1.0)
    emap.update(cloud, T, T, 0.3)
    hit = emap.validity.clone()
    assert hit.any() and not hit.all()
    for dt in (0.1, torch.tensor([0.7, 0.0]), 5.0):
        emap.update(nans(2), T, T, dt)
        last_hit = emap.state.elapsed[:, None, None] * 1e-9 - emap.time
        torch.testing.assert_close(last_hit[hit], torch.full_like(last_hit[hit], 1.3))
    emap.update(cloud, T, T, 0.3)
    now = emap.state.elapsed[:, None, None] * 1e-9
    torch.testing.assert_close((now - emap.time)[hit], now.expand_as(emap.time)[hit])


def test_the_variance_grows_to_its_maximum():
    emap = small_map(1, aging=AgingConfig(variance_rate=0.4), fusion=FusionConfig(max_variance=0.5))
    emap.load_state(random_state(np.random.default_rng(0), emap.cfg.grid, known=1.0))
    for _ in range(2):
        emap.update(nans(1), pose(), None, 1.0)
    assert (emap.layer("variance") == 0.5).all()


def test_refuses():
    with pytest.raises(ValueError, match="aging.variance_rate"):
        AgingConfig(variance_rate=-1.0)


@pytest.mark.parametrize("run", [by_tensors, by_cpu])
def test_no_variance_grows_beyond_its_maximum(run):
    fusion, aging = FusionConfig(max_variance=0.25), AgingConfig(variance_rate=0.5)
    emap = small_map(2, (19, 21), fusion=fusion, aging=aging)
    if run is by_cpu:
        require_cpu_backend(emap)
    state = random_state(np.random.default_rng(0), emap.cfg.grid, 2, 0.6, torch.float32)
    state.variance.mul_(20.0)
    after = run(emap, state, inputs_of(emap, nans(2), pose(num_envs=2), None), "age")
    expected = torch.where(state.validity, (state.variance + 0.5 * 0.3).clamp(max=0.25), state.variance)
    torch.testing.assert_close(after.variance, expected)
    assert 0.1 < (expected == 0.25).float().mean() < 0.9 and not state.validity.all()
