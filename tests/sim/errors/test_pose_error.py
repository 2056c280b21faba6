"""Estimated poses are off by what their config says, and a random walk's variance grows with time and way.

Bounds on statistics are five standard errors of the sample.
"""

import math

import pytest
import torch

from tests.devices import NoConstants, OneDevice
from tests.helpers import NoGenerator, pose
from torchelev.sim.errors.pose_error import PoseErrorConfig, PoseErrors
from torchelev.sim.errors.presets import PRESETS, preset

B = 8000
DRIFT = dict(
    drift_xy_time=0.02,
    drift_z_time=0.03,
    drift_yaw_time_deg=0.5,
    drift_xy_distance=0.05,
    drift_z_distance=0.04,
    drift_yaw_distance_deg=1.0,
)
LIVELY = PoseErrorConfig(bias_z=(-0.1, 0.1), bias_yaw_deg=(-5.0, 5.0), noise_xy=(0.0, 0.01), noise_z=0.01, **DRIFT)


def make(num_envs=B, seed=0, **fields):
    """Errors of a config."""
    return PoseErrors(PoseErrorConfig(**fields), num_envs, seed=seed)


def at(x=0.0, y=0.0, z=0.0, num_envs=B, **angles):
    """The same pose for all, float64."""
    return pose((x, y, z), num_envs=num_envs, **angles)


def yaw_of(T):
    """Angle of the x axis in the plane [rad]."""
    return torch.atan2(T[:, 1, 0], T[:, 0, 0])


def assert_mean(sample, mean, sigma):
    """The sample's mean is that of a distribution with this mean and sigma."""
    assert abs(float(sample.mean()) - mean) <= 5 * sigma / math.sqrt(len(sample))


def assert_sigma(sample, sigma):
    """The sample's standard deviation is that of a normal distribution with this sigma."""
    assert abs(float(sample.std()) - sigma) <= 5 * sigma / math.sqrt(2 * len(sample))


def test_no_errors_change_nothing():
    errors = make(3)
    for dtype in (torch.float32, torch.float64):
        T = at(1.0, 2.0, 3.0, num_envs=3, yaw=0.4, pitch=0.2).to(dtype)
        got = errors(T, 0.1)
        torch.testing.assert_close(got, T, atol=0, rtol=0)
        assert got.data_ptr() != T.data_ptr()


def test_the_variance_of_drift_grows_with_time_and_with_the_way():
    errors = make(**DRIFT | {"drift_yaw_time_deg": 0.0, "drift_yaw_distance_deg": 0.0})
    errors(at(), 0.1)
    for k in range(1, 41):  # 0.1 s and 0.05 m a step
        T = at(0.03 * k, 0.04 * k)
        got = errors(T, 0.1)
        if k in (10, 40):
            t, d = 0.1 * k, 0.05 * k
            error = got[:, :3, 3] - T[:, :3, 3]
            for axis, (of_time, of_way) in enumerate(((0.02, 0.05), (0.02, 0.05), (0.03, 0.04))):
                sigma = math.sqrt(of_time**2 * t + of_way**2 * d)
                assert_mean(error[:, axis], 0.0, sigma)
                assert_sigma(error[:, axis], sigma)
            torch.testing.assert_close(got[:, :3, :3], T[:, :3, :3], atol=0, rtol=0)


def test_the_variance_of_the_yaw_grows_alike():
    errors = make(drift_yaw_time_deg=0.5, drift_yaw_distance_deg=1.0)
    errors(at(yaw=1.0), 0.1)
    for k in range(1, 21):
        got = errors(at(z=0.1 * k, yaw=1.0), 0.2)  # climbing counts as way
    sigma = math.radians(math.sqrt(0.5**2 * 4.0 + 1.0**2 * 2.0))
    assert_mean(yaw_of(got) - 1.0, 0.0, sigma)
    assert_sigma(yaw_of(got) - 1.0, sigma)


def test_standing_still_drifts_with_time_alone():
    errors = make(drift_z_distance=1.0, drift_xy_time=0.02)
    for _ in range(10):
        got = errors(at(5.0, 1.0, 0.4), 0.1)
    assert bool((got[:, 2, 3] == 0.4).all())
    assert_sigma(got[:, 0, 3] - 5.0, 0.02 * math.sqrt(0.9))  # the first call only notes where the robot is


def test_environments_may_differ_in_dt_and_in_way():
    errors = make(drift_z_time=0.1, drift_xy_distance=0.1)
    dt = torch.where(torch.arange(B) < B // 2, 0.1, 0.4).double()
    moved = torch.where(torch.arange(B) < B // 2, 0.9, 0.0)
    errors(at(), dt, moved)
    got = errors(at(7.0), dt, moved)  # `moved` counts, not the 7 m
    assert_sigma(got[: B // 2, 2, 3], 0.1 * math.sqrt(0.1))
    assert_sigma(got[B // 2 :, 2, 3], 0.1 * math.sqrt(0.4))
    assert_sigma(got[: B // 2, 0, 3], 0.1 * math.sqrt(0.9))
    torch.testing.assert_close(got[B // 2 :, 0, 3], at(7.0)[B // 2 :, 0, 3], atol=0, rtol=0)


def test_odometry_starts_at_the_truth_after_reset():
    errors = make(4, **DRIFT)
    errors(at(num_envs=4), 0.1)
    for k in range(5):
        errors(at(0.1 * k, num_envs=4), 0.1)
    errors.reset(mask=torch.tensor([True, False, False, True]))
    T = at(50.0, 20.0, num_envs=4)  # put elsewhere, as simulators do at reset
    got = errors(T, 0.1)
    torch.testing.assert_close(got[[0, 3]], T[[0, 3]], atol=0, rtol=0)
    assert bool(((got - T)[[1, 2], :3, 3].abs() > 1e-4).all())
    got = errors(T, 0.1)
    assert bool(((got - T)[:, :3, 3].abs() > 0).all())


def test_resetting_one_leaves_the_path_of_the_others_alone():
    errors = make(2, bias_yaw_deg=90.0)
    for k in range(4):  # 3 m along x are taken for 3 m along y
        got = errors(at(float(k), num_envs=2), 0.1)
        if k == 1:
            errors.reset(torch.tensor([0]))
    torch.testing.assert_close(got[:, :2, 3], torch.tensor([[2.0, 1.0], [0.0, 3.0]]).double(), atol=1e-5, rtol=0)


def test_an_error_of_the_heading_bends_the_path_wherever_it_starts():
    errors = make(1, bias_yaw_deg=90.0)
    got = errors(at(100.0, 50.0, 0.5, num_envs=1), 0.1)
    torch.testing.assert_close(got[0, :3, 3], torch.tensor([100.0, 50.0, 0.5]).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(got[0, :2, :2], torch.tensor([[0.0, -1.0], [1.0, 0.0]]).double(), atol=1e-6, rtol=0)
    for k in (1, 2, 3):  # 3 m along x, 1 m up
        got = errors(at(100.0 + k, 50.0, 0.5 + k / 3, num_envs=1), 0.1)
    torch.testing.assert_close(got[0, :3, 3], torch.tensor([100.0, 53.0, 1.5]).double(), atol=1e-5, rtol=0)


def test_noise_is_new_at_each_call_and_does_not_add_up():
    errors = make(noise_xy=0.01, noise_z=0.02, noise_yaw_deg=0.5)
    T = at(1.0, 2.0, 3.0, yaw=0.3)
    got = [errors(T, 0.1) for _ in range(20)]
    for axis, sigma in enumerate((0.01, 0.01, 0.02)):
        last, before = got[-1][:, axis, 3] - (axis + 1), got[-2][:, axis, 3] - (axis + 1)
        assert_mean(last, 0.0, sigma)
        assert_sigma(last, sigma)
        assert_mean(last * before, 0.0, sigma**2)  # independent of the last
    assert_sigma(yaw_of(got[-1]) - 0.3, math.radians(0.5))


def test_biases_are_the_values_themselves():
    got = make(2, bias_x=0.1, bias_y=-0.2, bias_z=0.3)(at(1.0, num_envs=2), 0.1)
    torch.testing.assert_close(got[:, :3, 3], torch.tensor([[1.1, -0.2, 0.3]] * 2).double())
    errors = make(bias_z=(-0.03, 0.03))
    z = errors(at(), 0.1)[:, 2, 3]
    assert float(z.abs().max()) <= 0.03
    assert_mean(z, 0.0, 0.06 / math.sqrt(12))
    assert torch.equal(errors(at(), 0.1)[:, 2, 3], z)


def test_roll_and_pitch_are_exact_and_poses_rigid():
    errors = PoseErrors(LIVELY, 50)
    for k in range(10):
        T = at(0.1 * k, num_envs=50, yaw=0.2 * k, pitch=0.3, roll=-0.2)
        got = errors(T, 0.1)
    torch.testing.assert_close(got[:, 2, :3], T[:, 2, :3], atol=1e-6, rtol=0)
    R = got[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand_as(R), atol=1e-5, rtol=0)
    assert got[:, 3].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 50


def test_far_from_the_origin_errors_are_the_same():
    def walk(x0):
        errors = PoseErrors(LIVELY, 20)
        for k in range(10):
            T = at(x0 + 0.125 * k, num_envs=20)
            got = errors(T, 0.1)
        return (got - T)[:, :3, 3]

    torch.testing.assert_close(walk(2.0**20), walk(0.0), atol=1e-6, rtol=0)


def test_the_same_seed_gives_the_same_errors_to_the_bit_and_environments_are_independent():
    def run(seed, ids):
        errors = PoseErrors(LIVELY, 6, seed=seed)
        for k in range(6):
            got = errors(at(0.1 * k, num_envs=6), 0.1)
            if k == 3:
                errors.reset(torch.tensor(ids))
        return got

    assert torch.equal(run(1, [2]), run(1, [2]))
    assert not torch.equal(run(1, [2]), run(2, [2]))
    one, more = run(1, [2]), run(1, [2, 4])
    assert torch.equal(one[[0, 1, 2, 3, 5]], more[[0, 1, 2, 3, 5]]) and not torch.equal(one[4], more[4])


def test_environments_draw_their_own_values_and_keep_them_until_reset():
    errors = make(drift_z_time=(0.0, 0.2))
    sigma = errors.value("drift_z_time").clone()
    assert float(sigma.min()) >= 0 and float(sigma.max()) <= 0.2
    assert_mean(sigma, 0.1, 0.2 / math.sqrt(12))
    errors(at(), 1.0)
    z = errors(at(), 1.0)[:, 2, 3]
    assert_sigma(z / sigma, 1.0)
    errors.reset(torch.tensor([7]))
    changed = errors.value("drift_z_time") != sigma
    assert changed.nonzero()[:, 0].tolist() == [7]


def test_errors_made_in_inference_mode_can_go_on_outside():
    errors = PoseErrors(LIVELY, 2)
    with torch.inference_mode():
        errors(at(num_envs=2), 0.1)
        errors.reset(torch.tensor([0]))
    errors(at(num_envs=2), 0.1)
    errors.reset()


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run(name):
    errors = PoseErrors(preset(name).pose, 5)
    T = at(num_envs=5)
    errors(T, 0.1)
    assert bool(errors(T, 0.1).isfinite().all())


def test_leg_odometry_drifts_as_its_source_says():
    # A walk of 120 m in steps of 1 m; the source's robots are 0.16 m off after 200 m to 7.7 m after 700 m.
    errors = PoseErrors(preset("leg_odometry").pose, 2000)
    T = at(num_envs=2000)
    for k in range(121):
        T[:, 0, 3] = float(k)
        got = errors(T, 2.0)
    off = (got - T)[:, :2, 3].norm(dim=-1)
    assert 0.16 * math.sqrt(120 / 200) < float(off.median()) < 7.7 * math.sqrt(120 / 700)


def test_bad_arguments_are_refused():
    errors = make(2)
    with pytest.raises(ValueError, match=r"T_map_base: expected \(2, 4, 4\), got \(3, 4, 4\)"):
        errors(at(num_envs=3), 0.1)
    with pytest.raises(ValueError, match="dt"):
        errors(at(num_envs=2), torch.zeros(3))
    with pytest.raises(ValueError, match="moved"):
        errors(at(num_envs=2), 0.1, torch.zeros(3))
    with pytest.raises(ValueError, match="PoseErrorConfig.drift_z_time"):
        PoseErrorConfig(drift_z_time=-0.1)
    with pytest.raises(ValueError, match="PoseErrorConfig.bias_z"):
        PoseErrorConfig(bias_z=(0.1, -0.1))
    with pytest.raises(TypeError, match="PoseErrorConfig"):
        PoseErrors({"bias_z": 0.1}, 2)


def test_host_reads_nothing_back(monkeypatch):
    # Tensors on "meta" have no values, so that reading one raises.
    monkeypatch.setattr(torch, "Generator", NoGenerator)
    errors = PoseErrors(LIVELY, 2, "meta")
    T = torch.empty(2, 4, 4, device="meta", dtype=torch.float64)
    with NoConstants(), OneDevice():
        errors(T, 0.1)
        errors(T, torch.empty(2, device="meta"), torch.empty(2, device="meta"))
        errors.reset(mask=torch.empty(2, dtype=torch.bool, device="meta"))


def test_the_covariance_is_that_of_the_errors():
    """Of robots that all walk the same bent way, with drift and noise; the bias is a known offset here."""
    errors = make(noise_xy=0.01, noise_z=0.02, noise_yaw_deg=0.5, bias_z=0.3, **DRIFT)
    for x, y in ((0.0, 0.0), (0.5, 0.0), (1.0, 0.5), (1.0, 1.0), (0.5, 1.5)):
        estimated = errors(at(x, y), dt=0.2)
    sample = torch.cat([estimated[:, :3, 3] - at(x, y)[:, :3, 3], yaw_of(estimated)[:, None]], -1)
    covariance = errors.covariance[:, [0, 1, 2, 5]][:, :, [0, 1, 2, 5]]
    assert torch.equal(covariance, covariance[:1].expand_as(covariance)) and not errors.covariance[:, 3:5].any()
    actual, expected = torch.cov(sample.T), covariance[0]
    std = expected.diagonal().sqrt()
    assert ((actual - expected).abs() <= 5 * (2 / B) ** 0.5 * std[:, None] * std).all()
    assert abs(expected[0, 3] / (std[0] * std[3])) > 0.2  # a yaw error moves the robot sideways
    errors.reset()
    errors(at(), dt=0.2)
    assert float(errors.covariance[0, 2, 2]) == pytest.approx(0.02**2)
