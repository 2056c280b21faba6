"""What must hold of whole updates, whatever the clouds, poses, sizes and dtypes."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import (
    assert_close,
    differences,
    off_borders,
    pose,
    random_clouds,
    random_poses,
    rotation,
    seen_from,
    small_map,
    snapshot,
    terrain,
)
from torchelev import AgingConfig, BodyConfig, DriftConfig, FusionConfig, OverlapConfig, RaycastConfig, SensorConfig
from torchelev.state import LAYERS, MapState, Statistics

SEEDS = st.integers(0, 10_000)
CLOUD_DTYPES = st.sampled_from([torch.float16, torch.float32, torch.float64])
MAP_DTYPES = st.sampled_from([torch.float32, torch.float64])
LIVELY = dict(
    sensor=SensorConfig(body=BodyConfig(lower=(-0.1, -0.1, -2), upper=(0.1, 0.1, 2))),
    raycast=RaycastConfig(min_time=0.05, min_incidence=0.05),
    drift=DriftConfig(min_points=5),
    overlap=OverlapConfig(radius=0.5, height=1.2, base_height=2.0),
)


def recording(seed, num_envs=1, updates=3, num_points=1200, dtype=torch.float32, **ground):
    """A short walk: (cloud, pose, dt) of each update. A box comes and goes, the map drifts, there is a ceiling."""
    rng = np.random.default_rng(seed)
    walk = []
    for k in range(updates):
        T = random_poses(rng, num_envs)
        clouds = []
        for b in range(num_envs):
            points = terrain(rng, num_points, roughness=0.004, **ground)
            points[:, 2] += 0.01 * k
            if k % 2 == 0:
                points[(np.abs(points[:, :2] - 0.3) < 0.15).all(1), 2] += 0.4
            points[: num_points // 50, 2] += 2.0
            clouds.append(seen_from(T[b : b + 1], points))
        walk.append((torch.cat(clouds).to(dtype), T, torch.from_numpy(rng.uniform(0.1, 0.5, num_envs))))
    return walk


def run(emap, walk, change=lambda cloud, T: (cloud, T)):
    for cloud, T, dt in walk:
        cloud, T = change(cloud, T)
        emap.update(cloud, T, T, dt)
    return emap


def test_the_recordings_give_every_stage_work():
    """Or the properties below would say nothing of it."""
    total = dict.fromkeys(Statistics._fields, 0.0)
    for seed in range(5):
        emap = small_map(**LIVELY)
        for update in recording(seed, updates=4):
            run(emap, [update])
            for name, value in emap.statistics._asdict().items():
                total[name] += value.abs().item()
    assert {n for n, v in total.items() if v == 0} == {"rejected_invalid", "rejected_range"}


# Batches --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(1)
@given(SEEDS, st.integers(2, 5), CLOUD_DTYPES, MAP_DTYPES)
def test_a_batch_equals_single_maps_bit_for_bit(seed, num_envs, cloud_dtype, map_dtype):
    walk = recording(seed, num_envs, dtype=cloud_dtype)
    batch = run(small_map(num_envs, dtype=map_dtype, **LIVELY), walk)
    for b in range(num_envs):
        single = small_map(1, dtype=map_dtype, **LIVELY)
        run(single, [(cloud[b : b + 1], T[b : b + 1], dt[b : b + 1]) for cloud, T, dt in walk])
        for name in MapState._fields[:-1]:
            assert torch.equal(getattr(batch.state, name)[b], getattr(single.state, name)[0]), name
        for name in Statistics._fields:
            assert torch.equal(getattr(batch.statistics, name)[b], getattr(single.statistics, name)[0]), name


@given(SEEDS, st.integers(2, 3))
def test_a_batch_of_several_sensors_equals_single_maps(seed, sensors):
    rng = np.random.default_rng(seed)
    T = torch.stack([random_poses(rng, sensors) for _ in range(3)])
    cloud = torch.stack([random_clouds(rng, T[b], 100) for b in range(3)])
    batch = small_map(3)
    batch.update(cloud, T, T[:, 0], 0.1)
    for b in range(3):
        single = small_map(1)
        single.update(cloud[b : b + 1], T[b : b + 1], T[b : b + 1, 0], 0.1)
        names = [n for n in MapState._fields[:-1] if not torch.equal(getattr(batch, n)[b], getattr(single, n)[0])]
        assert names == []


def test_environments_do_not_see_each_other():
    """Another cloud in one environment changes no bit of the others."""
    (cloud, T, dt), *_ = recording(0, 3)
    a, b = small_map(3), small_map(3)
    a.update(cloud, T, T, dt)
    cloud[1] = torch.rand(cloud[1].shape) - 0.5
    b.update(cloud, T, T, dt)
    for name in MapState._fields[:-1]:
        assert torch.equal(getattr(a, name)[::2], getattr(b, name)[::2]), name


# Points ---------------------------------------------------------------------------------------------------------------


@given(SEEDS, CLOUD_DTYPES)
def test_the_order_of_points_does_not_matter(seed, dtype):
    walk = recording(seed, dtype=dtype)
    order = torch.from_numpy(np.random.default_rng(seed).permutation(1200))
    given_order = run(small_map(**LIVELY), walk)
    shuffled = run(small_map(**LIVELY), walk, lambda cloud, T: (cloud[:, order], T))
    assert_close(given_order.state, shuffled.state, 2e-5)


@given(SEEDS, st.integers(0, 200), CLOUD_DTYPES)
def test_padding_changes_nothing(seed, extra, dtype):
    """NaN points before, between and after the others: the same bits, but for drift's mean, whose sum they reorder."""
    rng = np.random.default_rng(seed)
    walk = recording(seed, dtype=dtype)
    places = torch.from_numpy(np.sort(rng.choice(1200 + extra, 1200, replace=False)))

    def pad(cloud, T):
        return torch.full((1, 1200 + extra, 3), torch.nan, dtype=dtype).index_copy(1, places, cloud), T

    plain, padded = (run(small_map(**{**LIVELY, "drift": None}), walk, change) for change in (lambda c, T: (c, T), pad))
    assert differences(plain.state, padded.state, skip=("rejected_invalid",)) == []
    assert padded.statistics.rejected_invalid.item() == extra
    assert_close(run(small_map(**LIVELY), walk).state, run(small_map(**LIVELY), walk, pad).state, 1e-6)


@given(SEEDS)
def test_the_dtype_of_a_cloud_only_rounds_it(seed):
    walk = recording(seed, dtype=torch.float16)
    half, full = (
        run(small_map(**LIVELY), walk, lambda c, T, d=d: (c.to(d), T)) for d in (torch.float16, torch.float64)
    )
    assert differences(half.state, full.state) == []


@pytest.mark.slow(1)
@given(SEEDS)
def test_a_float32_map_is_a_float64_map_to_rounding(seed):
    walk = recording(seed)
    single, double = (run(small_map(dtype=d, **LIVELY), walk) for d in (torch.float32, torch.float64))
    both = single.validity & double.validity
    assert (single.validity != double.validity).float().mean() < 0.01
    error = (single.elevation - double.elevation)[both].abs()
    assert error.median() < 1e-6 and (error > 1e-4).float().mean() < 0.01


# Places ---------------------------------------------------------------------------------------------------------------


def moved(walk, T_new_old):
    """The same walk, elsewhere: the sensor sees the same from poses moved by a transform."""
    return [(cloud, T_new_old @ T, dt) for cloud, T, dt in walk]


@given(SEEDS, st.tuples(st.integers(-1000, 1000), st.integers(-1000, 1000)), st.floats(-3, 3))
def test_translation_by_whole_cells_commutes(seed, cells, climb):
    walk = recording(seed)
    shift = pose((cells[0] * 0.1, cells[1] * 0.1, climb))
    here, there = run(small_map(**LIVELY), walk), small_map(**LIVELY)
    run(there, moved(walk, shift))
    expected = here.state
    expected = expected._replace(
        corner=expected.corner + torch.tensor([cells]),
        base_height=expected.base_height + climb,
        elevation=torch.where(expected.validity, expected.elevation + climb, 0.0),
        challenger=torch.where(expected.challenger_support > 0, expected.challenger + climb, 0.0),
        upper_bound=expected.upper_bound + climb,
    )
    challenger = torch.where(there.challenger_support > 0, there.challenger, 0.0)
    got = there.state._replace(elevation=torch.where(there.validity, there.elevation, 0.0), challenger=challenger)
    assert_close(got, expected, 2e-5)
    torch.testing.assert_close(
        there.cell_centers(), here.cell_centers() + torch.tensor(cells).double() * 0.1, atol=1e-9, rtol=0
    )


@given(SEEDS)
def test_a_hundred_kilometres_away_the_map_is_the_same(seed):
    """float64 poses: no more than the rounding of 1e5 m in float64."""
    walk = recording(seed)
    here = run(small_map(**LIVELY), walk)
    there = run(small_map(**LIVELY), moved(walk, pose((1e5, -1e5, 0.0))))
    assert_close(there.state, here.state._replace(corner=here.corner + torch.tensor([1_000_000, -1_000_000])), 2e-5)
    xy = here.center[:, None, :2] + torch.rand(1, 50, 2, dtype=torch.float64) - 0.5
    values, valid = there.sample(xy + torch.tensor([1e5, -1e5], dtype=torch.float64))
    expected, expected_valid = here.sample(xy)
    both = valid & expected_valid
    assert (valid == expected_valid).float().mean() > 0.95  # weights of one half are decided by rounding
    torch.testing.assert_close(values[both], expected[both], atol=2e-5, rtol=0)


def quarter_turned(state):
    """The state seen from a map frame that is turned by 90 degrees: (x, y) -> (-y, x)."""

    def turn(layer):
        return layer.transpose(1, 2).flip(1)

    width = state.elevation.shape[2]
    layers = {n: turn(getattr(state, n)) for n in LAYERS}
    layers["gradient_x"], layers["gradient_y"] = -layers["gradient_y"], layers["gradient_x"]
    corner = torch.stack([-state.corner[:, 1] - width, state.corner[:, 0]], -1)
    return state._replace(corner=corner, **layers)


@given(SEEDS, st.sampled_from([(12, 10), (9, 9), (8, 13)]))
def test_rotation_by_a_quarter_turn_commutes(seed, cells):
    walk = recording(seed, cells=cells)
    turn = pose((0, 0, 0.0), yaw=np.pi / 2)
    here, there = small_map(cells=cells, **LIVELY), small_map(cells=cells[::-1], **LIVELY)
    agreed = True
    for update, turned in zip(walk, moved(walk, turn), strict=True):
        run(here, [update]), run(there, [turned])
        expected, state = quarter_turned(here.state), there.state
        assert torch.equal(state.corner, expected.corner)
        # Ray casting sorts rays into bins of azimuth whose borders rounding decides.
        differ = (state.validity != expected.validity) | (state.bounded != expected.bounded)
        both = state.validity & expected.validity
        # A cell more or fewer than there rates its neighbours and counts for the drift, which moves all heights after.
        assert not agreed or (state.elevation - expected.elevation)[both].abs().max() < 2e-5
        agreed = agreed and not bool(differ.any())
    assert differ.float().mean() < 0.02


@given(SEEDS)
def test_rotation_commutes_exactly_without_rays(seed):
    walk = recording(seed)
    turn = pose((0, 0, 0.0), yaw=np.pi / 2)
    assert np.allclose(rotation(np.pi / 2) @ [1, 0, 0], [0, 1, 0])
    here = run(small_map(cells=(12, 10), raycast=None), walk)
    there = run(small_map(cells=(10, 12), raycast=None), moved(walk, turn))
    assert_close(there.state, quarter_turned(here.state), 2e-5)


@given(SEEDS)
def test_world_fixed_cells_keep_their_bits_on_a_walk(seed):
    """NaN clouds, another shift in each environment: what stays in the window stays to the bit."""
    rng = np.random.default_rng(seed)
    emap = run(small_map(3, aging=AgingConfig(variance_rate=0.0), overlap=None), recording(seed, 3))
    for _ in range(3):
        before, corner = snapshot(emap), emap.corner.clone()
        T = random_poses(rng, 3, reach=0.6)
        emap.update(torch.full((3, 2, 3), torch.nan), T, T, 0.0)
        for b, (di, dj) in enumerate((emap.corner - corner).tolist()):
            i, j = slice(max(0, di), min(12, 12 + di)), slice(max(0, dj), min(10, 10 + dj))
            new_i, new_j = slice(i.start - di, i.stop - di), slice(j.start - dj, j.stop - dj)
            for name in ("elevation", "variance", "validity", "support", "time", "upper_bound", "bounded"):
                old, new = getattr(before, name)[b], getattr(emap.state, name)[b]
                if i.start < i.stop and j.start < j.stop:
                    assert torch.equal(new[new_i, new_j], old[i, j]), name
                blank = new.clone()
                blank[new_i, new_j] = 1 if name == "variance" else 0
                assert ((blank == 1) if name == "variance" else (blank == 0)).all(), f"{name} of entering cells"


# Certainty ------------------------------------------------------------------------------------------------------------


@given(SEEDS, st.floats(0.0, 1.0), st.booleans())
def test_an_inlier_never_raises_a_variance(seed, noise, edges):
    """Points within half a standard deviation of what the cell knows: only more certain."""
    rng = np.random.default_rng(seed)
    fusion = FusionConfig() if edges else FusionConfig(edges=None)
    emap = small_map(2, dtype=torch.float64, drift=None, fusion=fusion, sensor=SensorConfig(noise_factor=0.0))
    T = pose(num_envs=2)
    emap.load_state(
        emap.state._replace(
            validity=torch.rand(2, 12, 10, generator=torch.Generator().manual_seed(seed)) < 0.8,
            variance=torch.from_numpy(rng.uniform(1e-6, 1e-2, (2, 12, 10))),
            support=torch.from_numpy(rng.integers(0, 30, (2, 12, 10)).astype(float)),
        )
    )
    before, known = emap.variance.clone(), emap.validity.clone()
    xy = off_borders(rng.uniform(-0.6, 0.6, (2, 150, 2)) * [1, 0.8], 0.1)
    z = rng.uniform(-0.5, 0.5, (2, 150, 1)) * noise * emap.cfg.sensor.noise_floor**0.5
    cloud = torch.from_numpy(np.concatenate([xy, z - 1.0], -1))
    emap.update(cloud, T, None, 0.0)
    assert emap.statistics.points_used.tolist() == [150, 150]
    assert (emap.variance <= before)[known].all() and (emap.variance < before)[known].any()


@given(SEEDS)
def test_more_scans_of_flat_ground_make_it_more_certain(seed):
    emap = small_map(1, aging=AgingConfig(variance_rate=0.0))
    last = torch.full((1, 12, 10), torch.inf)
    for k in range(4):
        rng = np.random.default_rng(seed + k)
        ground = np.column_stack([off_borders(rng.uniform(-0.6, 0.6, (400, 2)), 0.1), rng.normal(0, 0.003, 400)])
        T = pose((0.02, 0.01, 1.0), yaw=float(rng.uniform(-3, 3)))
        emap.update(seen_from(T, ground), T, T, 0.1)
        variance = emap.layer("variance").nan_to_num(nan=torch.inf)
        assert (variance <= last).all()
        last = variance
    assert emap.layer("elevation").nan_to_num().abs().max() < 0.02


@given(SEEDS)
@settings(max_examples=10)
def test_values_stay_in_their_ranges(seed):
    emap = run(small_map(2, **LIVELY), recording(seed, 2, updates=5))
    cfg = emap.cfg
    variance, known = emap.layer("variance"), emap.validity
    assert (variance[known] > 0).all() and (variance[known] <= cfg.fusion.max_variance).all()
    assert (emap.time >= 0).all() and (emap.support >= 0).all()
    assert (emap.support <= cfg.fusion.max_support).all()
    assert (emap.traversability >= 0).all() and (emap.traversability <= 1).all()
