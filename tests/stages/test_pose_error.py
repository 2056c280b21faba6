"""The uncertainty of the sensor's pose, in points, in cells and in the whole map."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import differences, pose, random_poses, small_map
from tests.test_properties import LIVELY, recording
from torchelev import DriftConfig, FusionConfig, SensorConfig
from torchelev.layers import LAYERS
from torchelev.stages.cells import cells_of
from torchelev.stages.fusion.points import HitPoints, gather_points
from torchelev.stages.pose_error import relative_variance

SEEDS = st.integers(0, 10_000)
NOISE = 1e-4  # [m^2]
EXACT = dict(sensor=SensorConfig(noise_factor=0.0, noise_floor=NOISE, exclusion=None), raycast=None, overlap=None)


def covariances(rng, num_envs, *sensors, scale=0.02):
    root = torch.from_numpy(rng.normal(size=(num_envs, *sensors, 6, 6))) * scale
    return root @ root.mT


def of_height(variance, num_envs=1):
    covariance = torch.zeros(num_envs, 6, 6)
    covariance[:, 2, 2] = variance
    return covariance


def flat(height, num_points=1, side=0.0):
    """Points below a sensor 1 m above z = 0, within one cell, or in cells along a line."""
    points = torch.zeros(1, num_points, 3)
    points[..., 0] = 0.05 + side * torch.arange(num_points)
    points[..., 1], points[..., 2] = 0.05, height - 1.0
    return points


def update(emap, points, covariance=None, dt=0.1):
    emap.update(points, pose((0, 0, 1)), None, dt, pose_covariance=covariance)
    return emap


@given(SEEDS, st.integers(1, 3), st.integers(1, 3), st.booleans())
def test_points_agree_with_the_reference(seed, num_envs, sensors, each):
    rng = np.random.default_rng(seed)
    emap = small_map(num_envs, dtype=torch.float64)
    T = torch.stack([random_poses(rng, sensors, 1.0) for _ in range(num_envs)])
    covariance = covariances(rng, num_envs, sensors) if each else covariances(rng, num_envs)
    cloud = torch.from_numpy(rng.uniform(-2, 2, (num_envs, sensors, 20, 3)))
    m = emap.measure(cloud, T, None, 0.1, pose_covariance=covariance)
    exact = emap.measure(cloud, T, None, 0.1)
    assert torch.equal(m.noise, exact.variance) and torch.equal(m.used, exact.used)
    added = (m.variance - m.noise).view(num_envs, sensors, -1)
    for b in range(num_envs):
        for s in range(sensors):
            for k in range(20):
                turned = T[b, s, :3, :3] @ cloud[b, s, k]
                expected = reference.pose_variance(
                    turned.tolist(), (covariance[b, s] if each else covariance[b]).tolist()
                )
                assert float(added[b, s, k]) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("num_points", [1, 9])
def test_a_scan_is_as_certain_as_its_pose_however_many_points_it_has(num_points):
    emap = update(small_map(**EXACT), flat(0.0, num_points), of_height(0.01))
    variance = emap.layer("variance")[emap.layer("validity") == 1]
    assert float(variance) == pytest.approx(0.01 + NOISE / num_points)


def test_without_drift_compensation_scans_are_independent():
    """R = noise + J Sigma J^T; equations (1) and (2) of the paper."""
    emap = small_map(**EXACT, drift=None)
    for height in (0.0, 0.06):
        update(emap, flat(height), of_height(0.01), dt=0.0)
    R = 0.01 + NOISE
    h, variance = reference.kalman(0.0, R, [(0.06, R)])
    known = emap.layer("validity") == 1
    assert float(emap.layer("elevation")[known]) == pytest.approx(h, abs=1e-6)
    assert float(emap.layer("variance")[known]) == pytest.approx(variance, rel=1e-3)


def test_a_map_moved_to_the_scan_is_as_uncertain_as_the_scans_pose():
    """Wherever it was known before, also out of view: all heights share the error, which no number of scans reduces."""
    emap = small_map(**EXACT, drift=DriftConfig(min_points=5, min_traversability=0.0))
    line = flat(0.0, 12, side=0.1) - torch.tensor([0.6, 0.0, 0.0])
    for variance in (0.0, 0.0009, 0.0025):
        for _ in range(5):
            update(emap, line, of_height(variance), dt=0.0)
        own, known = emap.state.variance, emap.state.validity
        assert float(own[known].max()) < NOISE
        torch.testing.assert_close(emap.layer("variance")[known], own[known] + variance)


def test_a_map_that_stays_takes_over_what_it_shared():
    emap = update(small_map(**EXACT), flat(0.0, 3), of_height(0.01))
    before = emap.layer("variance")
    update(emap, flat(0.0, 0), of_height(0.04), dt=0.0)  # no points: nothing to move it by
    torch.testing.assert_close(emap.layer("variance"), before, equal_nan=True)
    assert float(emap.state.pose_covariance[0, 2, 2]) == 0.0


@given(SEEDS)
def test_the_layer_agrees_with_the_reference(seed):
    rng = np.random.default_rng(seed)
    emap = small_map(dtype=torch.float64)
    (cloud, T, dt), *_ = recording(seed, updates=1)
    emap.update(cloud, T, T, dt, pose_covariance=covariances(rng, 1))
    state, variance = emap.state, emap.layer("variance")[0]
    for i, j in torch.nonzero(state.validity[0])[::7].tolist():
        gradient = state.gradient_x[0, i, j].item(), state.gradient_y[0, i, j].item()
        own = state.variance[0, i, j].item()
        expected = reference.absolute_variance(own, gradient, state.pose_covariance[0].tolist())
        assert float(variance[i, j]) == pytest.approx(expected, rel=1e-9)


@given(SEEDS, st.integers(2, 4))
def test_a_batch_equals_single_maps_bit_for_bit(seed, num_envs):
    rng = np.random.default_rng(seed)
    walk, covariance = recording(seed, num_envs), covariances(rng, num_envs)
    batch = small_map(num_envs, **LIVELY)
    for cloud, T, dt in walk:
        batch.update(cloud, T, T, dt, pose_covariance=covariance)
    for b in range(num_envs):
        single = small_map(1, **LIVELY)
        for cloud, T, dt in walk:
            single.update(cloud[b, None], T[b, None], T[b, None], dt[b, None], pose_covariance=covariance[b, None])
        for name in LAYERS:
            assert torch.equal(batch.layer(name)[b].nan_to_num(-1), single.layer(name)[0].nan_to_num(-1)), name


@given(SEEDS)
def test_exact_poses_change_nothing(seed):
    told, untold = small_map(**LIVELY), small_map(**LIVELY)
    for cloud, T, dt in recording(seed):
        told.update(cloud, T, T, dt, pose_covariance=torch.zeros(1, 6, 6))
        untold.update(cloud, T, T, dt)
    assert not differences(told.state, untold.state)


def test_gradients_reach_the_covariance():
    emap = small_map(dtype=torch.float64, **EXACT)
    covariance = of_height(0.01).double().requires_grad_()
    m = emap.measure(flat(0.0, 2), pose((0, 0, 1)), None, 0.1, pose_covariance=covariance)
    emap.layer("variance", state=emap(emap.state, m)).nansum().backward()
    assert float(covariance.grad[0, 2, 2]) == pytest.approx(1.0)


def test_a_reset_forgets_the_poses_uncertainty():
    emap = update(small_map(**EXACT), flat(0.0), of_height(0.01))
    emap.reset()
    assert not emap.state.pose_covariance.any()


def test_a_checkpoint_of_before_loads():
    emap = update(small_map(**EXACT), flat(0.0), of_height(0.01))
    saved = {name: value for name, value in small_map(**EXACT).state_dict().items() if name != "pose_covariance"}
    emap.load_state_dict(saved)
    assert not emap.state.pose_covariance.any()


BAD = {
    "shape": (torch.zeros(1, 3, 3), ValueError, r"expected \(1, 6, 6\) or \(1, 1, 6, 6\), got \(1, 3, 3\)"),
    "type": (np.zeros((1, 6, 6)), TypeError, "must be a torch.Tensor"),
    "NaN": (torch.full((1, 6, 6), torch.nan), ValueError, "must be finite"),
    "asymmetric": (torch.eye(6)[None] + torch.ones(6, 6).triu(1), ValueError, "must be symmetric"),
    "negative": (-torch.eye(6)[None], ValueError, "must have no negative eigenvalue"),
}


@pytest.mark.parametrize(("covariance", "error", "words"), BAD.values(), ids=BAD)
def test_bad_covariances_are_refused_before_anything_changes(covariance, error, words):
    emap = small_map(**EXACT)
    with pytest.raises(error, match=f"pose_covariance.*{words}"):
        update(emap, flat(0.0), covariance)
    assert not emap.state.validity.any()


def test_the_gate_widens_with_the_pose():
    """A scan that is off by 20 cm contradicts the map if its pose is exact, and not if its pose may be off by 20 cm."""
    for variance, height in ((0.0, 0.0), (0.04, 0.0)):
        cfg = dict(**EXACT, drift=None, fusion=dataclasses.replace(FusionConfig(), relief=0.0))
        emap = small_map(**cfg)
        update(emap, flat(height, 9))
        update(emap, flat(0.2, 9), of_height(variance), dt=0.0)
        outliers = int(emap.statistics.rejected_outlier)
        assert outliers == (9 if variance == 0.0 else 0)


def test_the_gate_of_points_is_that_of_their_whole_variance():
    emap = small_map(**EXACT, dtype=torch.float64)
    covariance = covariances(np.random.default_rng(0), 1)
    m = emap.measure(flat(0.0, 4, side=0.1), pose((0, 0, 1)), None, 0.1, pose_covariance=covariance)
    cfg, grid, state = FusionConfig(), emap.cfg.grid, emap.state
    assert m.noise is not None
    shared, cells = relative_variance(state, m), cells_of(state, m, grid)
    scan = gather_points(HitPoints(m.points, m.noise, shared, m.origin, cells), grid, cfg)
    torch.testing.assert_close(scan.spread, m.variance + (cfg.relief * grid.resolution) ** 2)
    torch.testing.assert_close(scan.weight, 1 / m.noise)
