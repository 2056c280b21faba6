"""Sensor errors have the statistics that their config says, differ between environments, and repeat from a seed.

Bounds on statistics are five standard errors of the sample.
"""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import NoGenerator
from torchelev.sim.errors.error_models import SensorErrorConfig, SensorErrors, rigid
from torchelev.sim.errors.presets import PRESETS, preset
from torchelev.sim.errors.range_errors import across_edge

NAN = float("nan")
LIVELY = SensorErrorConfig(
    flying=(0.1, 0.9),
    too_short=(0.0, 0.1),
    too_long=0.05,
    range_constant=(0.0, 0.01),
    range_quadratic=0.002,
    range_step=0.001,
    point_noise=(0.0, 0.01),
    outliers=0.02,
    outlier_noise=0.2,
    disparity_step=0.001,
    dropout=(0.0, 0.3),
    missed_frames=0.2,
    latency=(0, 3),
    mounting_position=(0.0, 0.02),
    mounting_rotation_deg=1.0,
)


def rays(B, M, distance=None, seed=0):
    """Points (B, M, 3) in all directions, 1 to 4 m away or all at one distance."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(B, M, 3, generator=g), dim=-1)
    return direction * (1 + 3 * torch.rand(B, M, 1, generator=g) if distance is None else distance)


def poses(B, x=0.0):
    """Identity poses but for x."""
    T = torch.eye(4).repeat(B, 1, 1)
    T[:, 0, 3] = x
    return T


def make(num_envs=1, seed=0, **fields):
    """Errors of a config."""
    return SensorErrors(SensorErrorConfig(**fields), num_envs, seed=seed)


def assert_mean(sample, mean, sigma):
    """The sample's mean is that of a distribution with this mean and sigma."""
    assert abs(float(sample.double().mean()) - mean) <= 5 * sigma / math.sqrt(sample.numel())


def assert_sigma(sample, sigma):
    """The sample's standard deviation is that of a normal distribution with this sigma."""
    assert abs(float(sample.double().std()) - sigma) <= 5 * sigma / math.sqrt(2 * sample.numel())


def assert_share(sample, share):
    """The share of True is that of independent draws."""
    assert_mean(sample, share, math.sqrt(share * (1 - share)))


# Each error alone ---------------------------------------------------------------------------------------------------


def test_no_errors_change_nothing():
    points = rays(2, 50)
    points[0, 3] = NAN
    got = make(2)(points, poses(2))
    torch.testing.assert_close(got.points, points, atol=0, rtol=0, equal_nan=True)
    assert got.points.data_ptr() != points.data_ptr()
    assert torch.equal(got.T_map_sensor, poses(2))
    assert torch.equal(make(2).mounting(), poses(2))


@pytest.mark.parametrize(("distance", "sigma"), [(1.0, 0.005), (2.0, 0.014), (4.0, 0.050)])
def test_range_noise_grows_with_the_distance_and_stays_on_the_ray(distance, sigma):
    points = rays(2, 20_000, distance)
    got = make(2, range_constant=0.002, range_quadratic=0.003)(points).points
    error = got.norm(dim=-1) - distance
    assert_mean(error, 0.0, sigma)
    assert_sigma(error, sigma)
    assert float(torch.linalg.cross(got, points).norm(dim=-1).max()) < 1e-5


def test_point_noise_and_outliers():
    points = rays(1, 40_000)
    got = make(point_noise=0.01, outliers=0.25, outlier_noise=0.3)(points).points - points
    # A mixture of two normals: its variance is the mixture of theirs, its fourth moment gives the sampling error.
    mixed = [(0.75, 0.01), (0.25, 0.3)]
    variance = sum(p * s**2 for p, s in mixed)
    fourth = sum(p * 3 * s**4 for p, s in mixed)
    for axis in range(3):
        assert_mean(got[..., axis], 0.0, math.sqrt(variance))
        assert_mean(got[..., axis].square(), variance, math.sqrt(fourth - variance**2))
    far = got.abs().amax(-1) > 0.06  # beyond 6 sigma of the one, within 0.2 of the other
    within = math.erf(0.06 / 0.3 / math.sqrt(2)) ** 3
    assert_share(far, 0.25 * (1 - within))


def test_dropout_loses_points():
    lost = make(2, dropout=0.1)(rays(2, 20_000)).points.isnan()
    assert torch.equal(lost.all(-1), lost.any(-1))
    assert_share(lost.all(-1), 0.1)
    assert_share(lost[0, :, 0] & lost[1, :, 0], 0.01)  # each environment loses others


def test_missed_frames_lose_whole_clouds():
    errors = make(500, missed_frames=0.3)
    lost = torch.stack([errors(rays(500, 4)).points.isnan().flatten(1) for _ in range(10)])
    assert torch.equal(lost.all(-1), lost.any(-1))
    assert_share(lost.all(-1), 0.3)
    assert len({tuple(row.all(-1).tolist()) for row in lost}) > 1  # not the same at each step


@pytest.mark.parametrize(("field", "low", "high"), [("too_short", 0.1, 1.0), ("too_long", 1.05, 2.0)])
def test_artefacts_lie_on_their_ray_at_wrong_ranges(field, low, high):
    points = rays(1, 40_000)
    got = make(**{field: 0.2})(points).points
    ratio = got.norm(dim=-1) / points.norm(dim=-1)
    wrong = (ratio - 1).abs() > 1e-6
    assert_share(wrong, 0.2)
    assert float(ratio[wrong].min()) >= low - 1e-6 and float(ratio[wrong].max()) <= high + 1e-6
    assert_mean(ratio[wrong], (low + high) / 2, (high - low) / math.sqrt(12))


def test_artefacts_of_both_kinds_share_the_cloud():
    points = rays(1, 40_000)
    ratio = make(too_short=0.3, too_long=0.7)(points).points.norm(dim=-1) / points.norm(dim=-1)
    for wrong, share, low, high in ((ratio < 1.0, 0.3, 0.1, 1.0), (ratio > 1.04, 0.7, 1.05, 2.0)):
        assert_share(wrong, share)
        assert low - 1e-6 <= float(ratio[wrong].min()) and float(ratio[wrong].max()) <= high + 1e-6
        assert_mean(ratio[wrong], (low + high) / 2, (high - low) / math.sqrt(12))


def two_sides(B=200, h=12, w=10, near=1.0, far=3.0):
    """Clouds that are images: columns 0 to 3 near, the others far, along one ray each."""
    d = torch.full((B, h, w), far)
    d[..., :4] = near
    return rays(B, h * w, 1.0) * d.view(B, h * w, 1), d


def test_flying_pixels_lie_between_the_two_sides_of_an_edge():
    points, d = two_sides()
    got = make(200, flying=0.4)(points, image_shape=(12, 10)).points.norm(dim=-1).view_as(d)
    moved = (got - d).abs() > 1e-5
    assert not moved[..., :3].any() and not moved[..., 5:].any()
    for side in (3, 4):  # the last near column, the first far one
        assert_share(moved[..., side], 0.4)
        between = got[..., side][moved[..., side]]
        assert float(between.min()) >= 1.0 - 1e-6 and float(between.max()) <= 3.0 + 1e-6
        assert_mean(between, 2.0, 2 / math.sqrt(12))


def test_flying_pixels_need_a_step_and_two_returns():
    points, d = two_sides(near=2.92)
    got = make(200, flying=1.0)(points, image_shape=(12, 10)).points  # 8 cm is below flying_step
    torch.testing.assert_close(got, points)
    points, d = two_sides()
    points[d.flatten(1) == 3.0] = NAN
    got = make(200, flying=1.0)(points, image_shape=(12, 10)).points
    torch.testing.assert_close(got, points, equal_nan=True)


def test_without_an_image_the_neighbours_are_those_in_the_order():
    d = torch.tensor([[1.0, 1.0, 3.0, 3.0, 3.1]])
    assert across_edge(d, (1, 5)).tolist() == [[1.0, 3.0, 1.0, pytest.approx(3.1), 3.0]]


@given(seed=st.integers(0, 10_000), h=st.integers(1, 4), w=st.integers(1, 5))
def test_the_neighbour_across_an_edge_is_the_one_that_differs_most(seed, h, w):
    rng = np.random.default_rng(seed)
    image = rng.uniform(1, 5, (h, w))
    image[rng.uniform(size=(h, w)) < 0.2] = np.nan
    got = across_edge(torch.from_numpy(image).view(1, -1), (h, w)).view(h, w).numpy()
    for i in range(h):
        for j in range(w):
            around = ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1))
            beside = [image[a, b] for a, b in around if 0 <= a < h and 0 <= b < w]
            most = np.nanmax([0.0, *(abs(v - image[i, j]) for v in beside)])
            if np.isnan(image[i, j]):
                assert np.isnan(got[i, j])
            else:
                assert abs(got[i, j] - image[i, j]) == most


def test_ranges_come_in_steps():
    points = rays(2, 1000)
    got = make(2, range_step=0.05)(points).points.norm(dim=-1)
    torch.testing.assert_close(got / 0.05, (got / 0.05).round(), atol=1e-3, rtol=0)
    assert float((got - points.norm(dim=-1)).abs().max()) <= 0.025 + 1e-5


def test_disparities_come_in_steps():
    points = rays(2, 5000)
    got = make(2, disparity_step=0.02)(points).points
    seen = points[..., 0] > 0.05
    steps = 1 / got[seen][:, 0] / 0.02
    torch.testing.assert_close(steps, steps.round(), atol=0.01, rtol=1e-4)
    # Half a step of 0.02 / m at x = 2 m is 0.01 * 2^2 = 4 cm.
    near_two = (points[..., 0] - 2).abs() < 0.2
    worst = float((got - points)[near_two][:, 0].abs().max())
    assert 0.03 < worst < 0.05
    assert bool(got[points[..., 0] <= 0].isnan().all())  # behind the camera
    assert float(torch.linalg.cross(got[seen], points[seen]).norm(dim=-1).max()) < 1e-4


def test_disparity_by_hand():
    # 1 / 1.9 = 0.5263 = 5.26 steps of 0.1, so 5: x = 2, and y grows by 2 / 1.9. 1 / 25 is rounded to no disparity.
    points = torch.tensor([[[1.9, 0.95, 0.0], [25.0, 0.0, 0.0]]])
    got = make(disparity_step=0.1)(points).points
    torch.testing.assert_close(got, torch.tensor([[[2.0, 1.0, 0.0], [NAN, NAN, NAN]]]), equal_nan=True)


# Latency ------------------------------------------------------------------------------------------------------------


def numbered(errors, count, first=0, B=4):
    """Feed clouds numbered by their x, at poses of the same number; return the numbers that come out (count, B)."""
    actual, where = [], []
    for k in range(first, first + count):
        got = errors(torch.full((B, 3, 3), float(k)), poses(B, k))
        actual.append(got.points[:, 0, 0])
        where.append(got.T_map_sensor[:, 0, 3])
    return torch.stack(actual), torch.stack(where)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_clouds_are_late_by_exactly_n_calls_with_their_own_pose(n):
    actual, where = numbered(make(4, latency=n), 8)
    for k in range(8):
        if k < n:
            assert bool(actual[k].isnan().all()) and where[k].tolist() == [k] * 4  # nothing has come yet
        else:
            assert actual[k].tolist() == [k - n] * 4 and where[k].tolist() == [k - n] * 4


def test_a_clock_offset_brings_the_pose_of_now():
    actual, where = numbered(make(4, latency=2, clock_offset=True), 6)
    assert actual[5].tolist() == [3.0] * 4 and where[5].tolist() == [5.0] * 4


def test_each_environment_has_its_own_latency_and_reset_forgets_its_clouds_alone():
    errors = make(64, latency=(0, 2))
    n = errors.value("latency")
    assert set(n.tolist()) == {0.0, 1.0, 2.0}
    actual, _ = numbered(errors, 5, B=64)
    torch.testing.assert_close(actual[4], 4 - n)
    mask = torch.arange(64) < 10
    errors.reset(mask=mask)
    n = torch.where(mask, errors.value("latency"), n)
    actual, where = numbered(errors, 3, first=5, B=64)
    for k in range(3):
        expected = torch.where(mask & (n > k), torch.tensor(NAN), 5 + k - n)
        torch.testing.assert_close(actual[k], expected, equal_nan=True)
    torch.testing.assert_close(where[2], 7 - n)


def test_latencies_are_drawn_evenly_with_both_ends():
    n = make(30_000, latency=(1, 4)).value("latency")
    for k in (1, 2, 3, 4):
        assert_share(n == k, 0.25)


def test_a_ring_made_in_inference_mode_can_be_written_outside():
    errors = make(4, latency=1)
    with torch.inference_mode():
        numbered(errors, 2)
        errors.reset(torch.tensor([1]))
    actual, _ = numbered(errors, 2, first=2)
    assert actual[1].tolist() == [2.0] * 4


# Draws --------------------------------------------------------------------------------------------------------------


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


def test_an_environment_depends_on_its_own_cloud_alone():
    clouds = rays(3, 60)
    one, other = (SensorErrors(LIVELY, 3)(c, poses(3), image_shape=(6, 10)).points for c in (clouds, clouds * 0.5))
    mixed = SensorErrors(LIVELY, 3)(torch.stack([clouds[0], clouds[1] * 0.5, clouds[2]]), poses(3), image_shape=(6, 10))
    expected = torch.stack([one[0], other[1], one[2]])
    torch.testing.assert_close(mixed.points, expected, atol=0, rtol=0, equal_nan=True)


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


# Mounting -----------------------------------------------------------------------------------------------------------


def test_mounting_is_rigid_with_the_spread_it_says():
    T = make(20_000, mounting_position=0.02, mounting_rotation_deg=2.0).mounting()
    R = T[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(20_000), atol=1e-5, rtol=0)
    assert T[:, 3].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 20_000
    for axis in range(3):
        assert_sigma(T[:, axis, 3], 0.02)
    turn = torch.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], -1) / 2
    for axis in range(3):  # sin(a) / a differs from 1 by 1e-3 at 4 degrees, the bound is 2.5e-2
        assert_mean(turn[:, axis], 0.0, math.radians(2.0))
        assert_sigma(turn[:, axis], math.radians(2.0))


def test_mounting_stays_until_reset():
    errors = make(3, mounting_position=0.02)
    first = errors.mounting()
    errors(rays(3, 5))
    assert torch.equal(errors.mounting(), first)


def test_rotation_vectors_by_hand():
    vector = torch.tensor([[0.0, 0.0, math.pi / 2], [math.pi, 0.0, 0.0], [0.0, 0.0, 0.0]])
    T = rigid(vector, torch.tensor([[1.0, 2.0, 3.0]]).expand(3, 3))
    torch.testing.assert_close(T[0, :3, :3], torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(T[1, :3, :3], torch.diag(torch.tensor([1.0, -1, -1])), atol=1e-6, rtol=0)
    torch.testing.assert_close(T[2, :3, :3], torch.eye(3), atol=0, rtol=0)
    assert T[:, :3, 3].tolist() == [[1.0, 2.0, 3.0]] * 3


# Refusals and presets -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"dropout": 1.2}, "SensorErrorConfig.dropout"),
        ({"dropout": (0.3, 0.1)}, "low <= high"),
        ({"range_constant": -0.1}, "range_constant"),
        ({"range_constant": NAN}, "finite"),
        ({"range_constant": (0.0, 0.1, 0.2)}, "one value or a pair"),
        ({"range_constant": "0.1"}, "finite"),
        ({"latency": 1.5}, "whole"),
        ({"too_short": 0.6, "too_long": 0.6}, "sum to 1"),
    ],
)
def test_bad_configs_are_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        SensorErrorConfig(**fields)


def test_bad_kinds_and_numbers_are_refused():
    with pytest.raises(ValueError, match="sum to 1"):
        SensorErrors([(0.6, SensorErrorConfig())], 1)
    with pytest.raises(TypeError, match="SensorErrorConfig"):
        SensorErrors({"dropout": 0.1}, 1)
    with pytest.raises(TypeError, match="pairs"):
        SensorErrors([SensorErrorConfig()], 1)
    with pytest.raises(ValueError, match="num_envs"):
        SensorErrors(SensorErrorConfig(), 0)


def test_bad_calls_are_refused_before_anything_changed():
    errors = make(2, latency=1)
    with pytest.raises(ValueError, match=r"points: expected \(2, M, 3\), got \(3, 5, 3\)"):
        errors(rays(3, 5), poses(2))
    with pytest.raises(ValueError, match="T_map_sensor: must be given where clouds are late"):
        errors(rays(2, 5))
    with pytest.raises(ValueError, match="T_map_sensor"):
        errors(rays(2, 5), poses(3))
    with pytest.raises(ValueError, match="image_shape"):
        errors(rays(2, 5), poses(2), image_shape=(2, 3))
    assert errors.delay.clouds is None
    errors(rays(2, 5), poses(2))
    with pytest.raises(ValueError, match="one SensorErrors for each sensor"):
        errors(rays(2, 6), poses(2))
    with pytest.raises(ValueError, match="exclude"):
        errors.reset(torch.tensor([0]), mask=torch.tensor([True, False]))
    with pytest.raises(ValueError, match="env_ids"):
        errors.reset(torch.tensor([2]))
    with pytest.raises(ValueError, match="mask"):
        errors.reset(mask=torch.tensor([True]))


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run(name):
    errors = SensorErrors(preset(name).sensor, 3)
    got = errors(rays(3, 60), poses(3), image_shape=(6, 10))
    assert got.points.shape == (3, 60, 3) and got.points.dtype == torch.float32


def test_presets_have_the_numbers_of_their_sources():
    camera = SensorErrors(preset("depth_camera").sensor, 2000)
    at_one, at_four = camera.value("range_quadratic"), 16 * camera.value("range_quadratic")
    assert 0.0015 < float(at_one.min()) < 0.0016 and 0.0037 < float(at_one.max()) < 0.0038
    assert 0.024 < float(at_four.min()) and float(at_four.max()) < 0.061
    shares = [share for share, _ in preset("miki_2022").sensor]
    assert shares == [0.6, 0.3, 0.1]
    assert preset("ame_2").sensor.dropout == 0.15
    assert preset("perfect").sensor == SensorErrorConfig()
    with pytest.raises(ValueError, match=", ".join(PRESETS)):
        preset("kinect")


def test_host_reads_nothing_back(monkeypatch):
    # Tensors on "meta" have no values, so that reading one raises.
    monkeypatch.setattr(torch, "Generator", NoGenerator)
    errors = SensorErrors(LIVELY, 2, "meta")
    for constructor in ("tensor", "as_tensor", "from_numpy"):
        monkeypatch.setattr(torch, constructor, None)
    points, T = torch.empty(2, 60, 3, device="meta"), torch.empty(2, 4, 4, device="meta")
    errors(points, T, image_shape=(6, 10))
    errors.mounting()
    errors.reset(mask=torch.empty(2, dtype=torch.bool, device="meta"))
    errors.reset(torch.empty(1, dtype=torch.int64, device="meta"))
