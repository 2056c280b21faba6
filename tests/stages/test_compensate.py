"""Height drift."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import pose, random_state, seen_from, small_config, small_map, terrain
from torchelev import DriftConfig, LearnedTraversabilityConfig, SensorConfig, TraversabilityConfig
from torchelev.stages.compensate.stage import compensate
from torchelev.state import LAYERS

SIGMA2 = 1e-4


@given(st.integers(0, 10_000), st.floats(-0.15, 0.15), st.floats(0.1, 1.0), st.sampled_from([1, 20, 1000]))
def test_agrees_with_the_reference(seed, offset, gain, min_points):
    rng = np.random.default_rng(seed)
    sensor = SensorConfig(noise_factor=0.0, noise_floor=SIGMA2)
    emap = small_map(2, (7, 6), dtype=torch.float64, sensor=sensor)
    cfg = DriftConfig(gain=gain, min_points=min_points, max_error=0.4, max_variance=5e-3, min_traversability=0.5)
    state = random_state(rng, emap.cfg.grid, 2)
    points = [terrain(rng, 150, (7, 6), roughness=0.1) + [0, 0, offset] for _ in range(2)]
    T = pose((0.1, 0.2, 1.0), num_envs=2)
    m = emap.measure(seen_from(T, torch.from_numpy(np.stack(points))), T, None, 0.1)
    grid = emap.cfg.grid
    after = compensate(state, m, grid, cfg, 0.5, 1e6)
    for b in range(2):
        layers = {name: getattr(state, name)[b].numpy() for name in LAYERS}
        used = [p for p, u in zip(points[b], m.used[b], strict=True) if u]
        settings = dataclasses.asdict(cfg)
        del settings["inliers"]
        number, mean, correction = reference.drift(
            layers, used, state.corner[b].tolist(), 0.1, sigma2=SIGMA2, **settings
        )
        assert after.statistics.drift_points[b] == number
        assert float(after.statistics.drift_error[b]) == pytest.approx(mean, abs=1e-9)
        assert float(after.statistics.drift_correction[b]) == pytest.approx(correction, abs=1e-9)
        shift = (after.elevation[b] - state.elevation[b])[state.validity[b]]
        torch.testing.assert_close(shift, torch.full_like(shift, correction))
        risen = state.challenger_support[b] > 0
        moved = (after.challenger[b] - state.challenger[b])[risen]
        torch.testing.assert_close(moved, torch.full_like(moved, correction))
        bound = (after.upper_bound[b] - state.upper_bound[b])[state.bounded[b]]
        torch.testing.assert_close(bound, torch.full_like(bound, correction))
    assert torch.equal(after.validity, state.validity) and torch.equal(after.variance, state.variance)


def flat_cloud(height, num_envs=1):
    x, y = np.meshgrid(np.arange(-0.58, 0.6, 0.03), np.arange(-0.48, 0.5, 0.03), indexing="ij")
    cloud = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])
    return seen_from(pose(num_envs=num_envs), cloud)


def test_the_map_moves_to_the_newest_scan():
    """5 cm of sinking odometry: cells that the new scan does not see move as well."""
    emap = small_map(1)
    emap.update(flat_cloud(0.0), pose(), None, 0.1)
    front = flat_cloud(0.05)
    front[front[..., 0] < 0] = torch.nan
    emap.update(front, pose(), None, 0.1)
    torch.testing.assert_close(emap.layer("elevation"), torch.full((1, 12, 10), 0.05), atol=2e-3, rtol=0)
    assert emap.statistics.drift_error.item() == pytest.approx(0.05, abs=1e-4)
    assert emap.statistics.drift_correction.item() == pytest.approx(0.05, abs=1e-4)


def test_each_environment_drifts_on_its_own():
    emap = small_map(2)
    emap.update(flat_cloud(0.0, 2), pose(num_envs=2), None, 0.1)
    cloud = flat_cloud(0.0, 2)
    cloud[1, :, 2] -= 0.03
    emap.update(cloud, pose(num_envs=2), None, 0.1)
    torch.testing.assert_close(emap.statistics.drift_correction, torch.tensor([0.0, -0.03]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("drift", [None, DriftConfig(min_points=5000), DriftConfig(max_drift=0.02)])
def test_off_or_too_few_points_or_too_much_drift(drift):
    emap = small_map(1, drift=drift)
    emap.update(flat_cloud(0.0), pose(), None, 0.1)
    emap.update(flat_cloud(0.05), pose(), None, 0.1)
    assert emap.statistics.drift_correction.item() == 0


@pytest.mark.parametrize("gate, counts", [(0.6, True), (0.61, False)])
def test_ground_counts_from_the_gate_on(gate, counts):
    """Ground rated 0.6 counts from 0.6 on."""
    emap = small_map(1)
    emap.update(flat_cloud(0.0), pose(), None, 0.1)
    state = emap.state._replace(traversability=torch.full_like(emap.state.traversability, 0.6))
    m = emap.measure(flat_cloud(0.05), pose(), None, 0.1)
    after = compensate(state, m, emap.cfg.grid, DriftConfig(), gate, 1e6)
    assert (after.statistics.drift_points.item() > 0) == counts


@pytest.mark.parametrize(
    "setting, head, gate",
    [
        (None, TraversabilityConfig(), TraversabilityConfig.drift_gate),
        (None, LearnedTraversabilityConfig(), LearnedTraversabilityConfig.drift_gate),
        (None, None, 0.0),
        (0.7, LearnedTraversabilityConfig(), 0.7),
    ],
)
def test_the_config_overrules_the_gate_of_the_head(setting, head, gate):
    cfg = small_config(drift=DriftConfig(min_traversability=setting), traversability=head)
    assert cfg.drift_gate == gate


@pytest.mark.parametrize("bad", [dict(gain=0.0), dict(gain=1.5), dict(min_points=0), dict(min_traversability=1.5)])
def test_refuses(bad):
    with pytest.raises(ValueError, match=f"drift.{next(iter(bad))}"):
        DriftConfig(**bad)
