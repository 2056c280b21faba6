"""Bad input: refused by name before anything changed. Bad points: ignored and counted."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils._pytree import tree_leaves

from tests.devices import unread
from tests.helpers import (
    differences,
    floats_finite,
    nans,
    pose,
    random_clouds,
    random_poses,
    scan,
    small_config,
    small_map,
    snapshot,
)
from torchelev import BodyConfig, ElevationMap, ElevationMapConfig, SensorConfig
from torchelev.state import Statistics, map_layers

B, N = 2, 30
META = torch.device("meta")


@pytest.fixture
def emap():
    """Two maps that know something, so that a change would show."""
    return mapped()


def mapped():
    emap = small_map(B)
    T = random_poses(np.random.default_rng(0), B)
    emap.update(random_clouds(np.random.default_rng(1), T, 200), T, T, 0.1)
    return emap


def call(emap, **changed):
    """update() with good arguments but for those changed."""
    good = dict(points=torch.zeros(B, N, 3) - 1, T_map_sensor=pose(num_envs=B), T_map_base=pose(num_envs=B), dt=0.1)
    emap.update(**{**good, **changed})


def broken(**entries):
    """Good poses (B, 4, 4) with some entries of the second changed, named r<row><column>."""
    T = pose(num_envs=B)
    for name, value in entries.items():
        T[1, int(name[1]), int(name[2])] = value
    return T


BAD_POSES = {
    "shape": (torch.eye(4), ValueError, r"expected \(2, 4, 4\)"),
    "other B": (pose(num_envs=3), ValueError, r"got \(3, 4, 4\)"),
    "3 x 4": (pose(num_envs=B)[:, :3], ValueError, r"got \(2, 3, 4\)"),
    "numpy": (pose(num_envs=B).numpy(), TypeError, "torch.Tensor.*got ndarray"),
    "dtype": (pose(num_envs=B).half(), TypeError, "float32, float64.*got torch.float16"),
    "device": (pose(num_envs=B).to(META), ValueError, "on cpu.*meta"),
    "scaled": (broken(r00=1.1), ValueError, "rigid"),
    "sheared": (broken(r01=0.1), ValueError, "rigid"),
    "mirrored": (broken(r22=-1.0), ValueError, "mirror"),
    "zero": (torch.zeros(B, 4, 4), ValueError, "rigid"),
    "far": (broken(r03=1e30), ValueError, "within 1e\\+09 m"),
    "last row": (broken(r30=0.5), ValueError, "last row.*got 0.5 0 0 1 in environment 1"),
    "transposed": (broken(r03=0.5).mT, ValueError, "last row.*got 0 0 1 1 in environment 0, 1"),
    "nan": (broken(r03=float("nan")), ValueError, "finite, got NaN or inf in environment 1"),
    "inf": (broken(r13=float("inf")), ValueError, "finite"),
    "nan rotation": (broken(r12=float("nan")), ValueError, "finite"),
}
BAD = {
    "points: one cloud": ("points", torch.zeros(N, 3), ValueError, r"\(B, N, 3\).*B = 2.*got \(30, 3\)"),
    "points: other B": ("points", torch.zeros(3, N, 3), ValueError, r"B = 2.*got \(3, 30, 3\)"),
    "points: 4 columns": ("points", torch.zeros(B, N, 4), ValueError, r"got \(2, 30, 4\)"),
    "points: S = 0": ("points", torch.zeros(B, 0, N, 3), ValueError, "at least one sensor"),
    "points: integers": ("points", torch.zeros(B, N, 3, dtype=torch.int64), TypeError, "float16.*got torch.int64"),
    "points: list": ("points", [[[0.0, 0, 0]]] * B, TypeError, "torch.Tensor.*got list"),
    "points: device": ("points", torch.zeros(B, N, 3, device=META), ValueError, "on cpu.*meta"),
    "dt: negative": ("dt", -0.1, ValueError, "negative.*got -0.1"),
    "dt: nan": ("dt", float("nan"), ValueError, "negative.*got nan"),
    "dt: inf": ("dt", float("inf"), ValueError, "negative.*got inf"),
    "dt: text": ("dt", "0.1", TypeError, "number.*got str"),
    "dt: bool": ("dt", True, TypeError, "number.*got bool"),
    "dt: None": ("dt", None, TypeError, "required, got none"),
    "dt: negative tensor": ("dt", torch.tensor([0.1, -0.1]), ValueError, "negative.*got -0.1 in environment 1"),
    "dt: negative scalar": ("dt", torch.tensor(-0.1), ValueError, "negative.*got -0.1"),
    "dt: nan tensor": ("dt", torch.tensor([0.1, torch.nan]), ValueError, "negative.*got nan in environment 1"),
    "dt: shape": ("dt", torch.zeros(3), ValueError, r"\(2,\).*got \(3,\)"),
    "dt: column": ("dt", torch.zeros(B, 1), ValueError, r"\(2,\).*got \(2, 1\)"),
    "dt: integers": ("dt", torch.zeros(B, dtype=torch.int64), TypeError, "got torch.int64"),
    "dt: device": ("dt", torch.zeros(B, device=META), ValueError, "on cpu.*meta"),
    "variance: shape": ("variance", torch.ones(B, N, 1), ValueError, r"expected \(2, 30\).*got \(2, 30, 1\)"),
    "variance: number": ("variance", 0.1, TypeError, "torch.Tensor.*got float"),
    "variance: device": ("variance", torch.ones(B, N, device=META), ValueError, "on cpu.*meta"),
    **{f"{T}: {name}": (T, *bad) for T in ("T_map_sensor", "T_map_base") for name, bad in BAD_POSES.items()},
    "T_map_sensor: None": ("T_map_sensor", None, TypeError, "torch.Tensor.*got NoneType"),
    "T_map_sensor: with sensors": ("T_map_sensor", pose(num_envs=B)[:, None], ValueError, r"got \(2, 1, 4, 4\)"),
}


@pytest.mark.parametrize("method", ["update", "measure"])
@pytest.mark.parametrize("case", BAD)
def test_update_refuses_and_changes_nothing(emap, case, method):
    name, value, error, text = BAD[case]
    before = snapshot(emap)
    with pytest.raises(error, match=f"^{name}: .*{text}.*; "):
        if method == "update":
            call(emap, **{name: value})
        else:
            good = dict(points=torch.zeros(B, N, 3), T_map_sensor=pose(num_envs=B), dt=0.1)
            emap.measure(**{**good, name: value})
    assert differences(before, snapshot(emap)) == []


@pytest.mark.parametrize("method", ["update", "measure"])
def test_dt_is_required(emap, method):
    """Without it visibility clean-up and ageing are off; the base may be left out all the same."""
    call, cloud, T, before = getattr(emap, method), torch.zeros(B, N, 3), pose(num_envs=B), snapshot(emap)
    for poses in ([T], [T, T]):
        with pytest.raises(TypeError, match="^dt: is required, .*0.0 for a further sensor of the same instant"):
            call(cloud, *poses)
    assert differences(before, snapshot(emap)) == []
    for arguments in (dict(dt=0.1), dict(T_map_base=T, dt=0.1)):
        call(cloud, T, **arguments)
    for arguments in ((T, 0.1), (None, 0.1)):
        call(cloud, T, *arguments)


UNSOUND = {"NaN": torch.nan, "infinite": torch.inf, "far": 1e30}


@pytest.mark.parametrize("of", ["sensor", "base", "both"])
def test_one_bad_pose_that_was_not_read_leaves_one_robot_out(of):
    """As on a GPU, where the host does not wait to read it."""
    assert_bad_poses_leave_one_robot_out(mapped(), mapped(), of)


def assert_bad_poses_leave_one_robot_out(emap, eager, of):
    """The second robot of a map gets a bad pose of the sensor, the base or both; the eager map only good ones."""
    good, before = pose(num_envs=B), map_layers(torch.clone, emap.state)
    cloud, far = torch.zeros(B, N, 3) - 1, pose((3.0, 0.0, 1.0), num_envs=B)
    bad = {name: torch.cat([far[:1], torch.full((1, 4, 4), value)]) for name, value in UNSOUND.items()}
    bad = {name: unread(T) for name, T in bad.items()}
    eager.update(cloud, far, far, 0.1)
    for T in bad.values():
        for layer, value in zip(tree_leaves(emap.state), tree_leaves(before), strict=True):
            layer.copy_(value)
        emap.update(cloud, good if of == "base" else T, good if of == "sensor" else T, 0.1)
        after, alone = emap.state, eager.state
        assert emap.statistics.rejected_invalid.tolist() == [0, N]
        assert torch.equal(after.corner[1], before.corner[1]) and after.base_height[1] == before.base_height[1]
        assert torch.equal(after.elevation[1], before.elevation[1])
        assert all(value.isfinite().all() for value in tree_leaves(after) if value.is_floating_point())
        if of == "both":
            torch.testing.assert_close(after.elevation[0], alone.elevation[0], rtol=0, atol=1e-6)
            assert torch.equal(after.corner[0], alone.corner[0]) and torch.equal(after.validity[0], alone.validity[0])


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -1.0])
def test_no_time_passes_in_one_bad_dt_that_was_not_read(bad):
    maps = [mapped(), mapped()]
    for emap, dt in zip(maps, (bad, 0.0), strict=True):
        call(emap, dt=unread(torch.tensor([0.1, dt])))
    for values in zip(*(tree_leaves(emap.state) for emap in maps), strict=True):
        assert torch.equal(*values)


def test_mend_of_a_transposed_pose(emap):
    with pytest.raises(ValueError, match="; transpose it"):
        call(emap, T_map_base=pose(num_envs=B).mT)
    with pytest.raises(ValueError, match="; use torchelev.frames.transform"):
        call(emap, T_map_base=broken(r30=0.5))


def test_sensors_need_a_pose_each(emap):
    with pytest.raises(ValueError, match=r"^T_map_sensor: expected \(2, 3, 4, 4\).*got \(2, 4, 4\)"):
        call(emap, points=torch.zeros(B, 3, N, 3))


BAD_RESETS = {
    "repeated": (dict(env_ids=torch.tensor([1, 1])), ValueError, r"env_ids: must not repeat.*\[1, 1\].*unique"),
    "too high": (dict(env_ids=torch.tensor([0, 2])), ValueError, r"env_ids: must lie in \[0, 2\).*0\.\.2"),
    "negative": (dict(env_ids=torch.tensor([-1])), ValueError, r"env_ids: must lie in \[0, 2\)"),
    "2-D": (dict(env_ids=torch.tensor([[0]])), ValueError, "env_ids: must be 1-D"),
    "list": (dict(env_ids=[0]), TypeError, "env_ids: .*got list"),
    "floats": (dict(env_ids=torch.tensor([0.0])), TypeError, "env_ids: must be int64.*float32"),
    "mask as ids": (dict(env_ids=torch.tensor([True, False])), TypeError, "env_ids: must be int64.*bool.*mask="),
    "device": (dict(env_ids=torch.zeros(1, dtype=torch.int64, device=META)), ValueError, "env_ids: .*cpu.*meta"),
    "mask of floats": (dict(mask=torch.ones(B)), TypeError, "mask: must be bool.*float32"),
    "mask shape": (dict(mask=torch.ones(3, dtype=torch.bool)), ValueError, r"mask: expected \(2,\).*\(3,\)"),
    "mask device": (dict(mask=torch.ones(B, dtype=torch.bool, device=META)), ValueError, "mask: .*cpu.*meta"),
    "both": (
        dict(env_ids=torch.tensor([0]), mask=torch.ones(B, dtype=torch.bool)),
        ValueError,
        "env_ids, mask: exclude each other",
    ),
}


@pytest.mark.parametrize("case", BAD_RESETS)
def test_reset_refuses_and_changes_nothing(emap, case):
    arguments, error, text = BAD_RESETS[case]
    before = snapshot(emap)
    with pytest.raises(error, match=text):
        emap.reset(**arguments)
    assert differences(before, snapshot(emap)) == []


BAD_READS = {
    "layer": (lambda e: e.layer("height"), KeyError, "layer: .*'height'.*elevation, variance"),
    "layer of sample": (lambda e: e.sample(torch.zeros(B, 1, 2), "height"), KeyError, "layer: .*'height'"),
    "mode": (lambda e: e.sample(torch.zeros(B, 1, 2), mode="cubic"), ValueError, "mode: .*bilinear.*'cubic'"),
    "shape": (lambda e: e.sample(torch.zeros(1, 2)), ValueError, r"xy: expected \(2, M, 2\), got \(1, 2\)"),
    "other B": (lambda e: e.sample(torch.zeros(3, 1, 2)), ValueError, r"xy: expected \(2, M, 2\), got \(3, 1, 2\)"),
    "columns": (lambda e: e.sample(torch.zeros(B, 1, 3)), ValueError, "xy: expected"),
    "integers": (lambda e: e.sample(torch.zeros(B, 1, 2, dtype=torch.int64)), TypeError, "xy: must be float16"),
    "device": (lambda e: e.sample(torch.zeros(B, 1, 2, device=META)), ValueError, "xy: must be on cpu.*meta"),
    "feet": (lambda e: e.initialize(torch.zeros(B, 3)), ValueError, r"feet: expected \(2, K, 3\)"),
    "feet device": (lambda e: e.initialize(torch.zeros(B, 3, 3, device=META)), ValueError, "feet: must be on cpu"),
}


@pytest.mark.parametrize("case", BAD_READS)
def test_readers_refuse_and_change_nothing(emap, case):
    read, error, text = BAD_READS[case]
    before = snapshot(emap)
    with pytest.raises(error, match=text):
        read(emap)
    assert differences(before, snapshot(emap)) == []


@pytest.mark.parametrize(
    "make, error, text",
    [
        (lambda: ElevationMap({"grid": {}}), TypeError, r"cfg: .*ElevationMapConfig, got \{.grid.: \{\}\}; give"),
        (lambda: ElevationMap(ElevationMapConfig(), num_envs=0), ValueError, "num_envs: .*positive.*got 0"),
        (lambda: ElevationMap(ElevationMapConfig(), num_envs=True), ValueError, "num_envs: .*positive.*got True"),
        (lambda: ElevationMap(ElevationMapConfig(), num_envs=2.0), ValueError, "num_envs: .*got 2.0"),
    ],
)
def test_construction_refuses(make, error, text):
    with pytest.raises(error, match=text):
        make()


# Bad points are no error ----------------------------------------------------------------------------------------------

HUGE = {
    "nan": (torch.nan, "rejected_invalid"),
    "inf": (torch.inf, "rejected_invalid"),
    "-inf": (-torch.inf, "rejected_invalid"),
    "on the sensor": (0.0, "rejected_range"),
    "1e6": (1e6, "rejected_range"),
    "1e30": (1e30, "rejected_range"),
    "-3e38": (-3e38, "rejected_range"),
}


@pytest.mark.parametrize("updates", [1, 2])
@pytest.mark.parametrize("case", HUGE)
def test_bad_points_are_counted_and_change_nothing(case, updates):
    """A cloud with bad points among good ones gives the map of the good ones alone, to the bit."""
    value, counter = HUGE[case]
    T = random_poses(np.random.default_rng(0), B)
    good = random_clouds(np.random.default_rng(1), T, 200)
    bad = torch.cat([good, torch.full((B, 7, 3), value)], 1)
    clean, dirty = small_map(B), small_map(B)
    for emap, cloud in ((clean, good), (dirty, bad)):
        for _ in range(updates):
            emap.update(cloud, T, T, 0.1)
    assert differences(clean.state, dirty.state, skip=(counter,)) == []
    assert getattr(dirty.statistics, counter).tolist() == [7, 7] and floats_finite(dirty.state) == []


@pytest.mark.parametrize("coordinate", range(3))
@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e30])
def test_one_bad_coordinate_is_enough(coordinate, value):
    emap = small_map(B)
    cloud = torch.zeros(B, 3, 3) - 0.5
    cloud[1, 1, coordinate] = value
    emap.update(cloud, pose(num_envs=B), dt=0.0)
    assert emap.statistics.points_used.tolist() == [3, 2] and floats_finite(emap.state) == []


@pytest.mark.parametrize("shape", [(B, 0, 3), (B, 1, 3), (B, 3, 0, 3), (B, 3, 1, 3)])
def test_few_points(shape):
    emap = small_map(B)
    T = pose(num_envs=B)
    sensors = T[:, None].repeat(1, 3, 1, 1) if len(shape) == 4 else T
    for _ in range(2):
        emap.update(torch.full(shape, -0.5), sensors, T, 0.1)
    number = shape[-2] * (3 if len(shape) == 4 else 1)
    assert floats_finite(emap.state) == [] and emap.statistics.points_used.tolist() == [number] * B
    assert emap.validity.sum() == (B if shape[-2] else 0)


def test_clouds_wholly_outside_are_counted():
    emap = small_map(B, sensor=SensorConfig(max_distance=1e7))
    cloud = torch.full((B, 9, 3), 5.0)
    cloud[:, :3] = 1e6
    cloud[..., 2] = -1.0
    for _ in range(2):
        emap.update(cloud, pose(num_envs=B), pose(num_envs=B), 0.1)
    assert emap.statistics.rejected_outside.tolist() == [9, 9] and not emap.validity.any()
    assert floats_finite(emap.state) == []


@pytest.mark.parametrize("x, y, z", [(1e6, -1e6, 0.0), (0.0, 0.0, 1e6), (-1e9, 0.0, 5.0)])
def test_poses_far_away(x, y, z):
    emap = small_map(B)
    emap.update(torch.zeros(B, 5, 3) - 0.5, pose(num_envs=B), pose(num_envs=B), 0.1)
    far = pose((x, y, z), num_envs=B)
    emap.update(torch.zeros(B, 5, 3) - 0.5, far, far, 0.1)
    assert floats_finite(emap.state) == []
    assert (emap.statistics.points_used + emap.statistics.rejected_outlier).tolist() == [5, 5]
    emap.update(torch.zeros(B, 5, 3) - 0.5, far, None, 0.1)
    emap.update(torch.zeros(B, 5, 3) - 0.5, pose(num_envs=B), None, 0.1)  # the sensor far from the window
    assert floats_finite(emap.state) == []


@pytest.mark.slow(2)
@given(st.integers(0, 10_000), st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64]))
def test_random_garbage_never_poisons_the_map(seed, dtype):
    rng = np.random.default_rng(seed)
    emap = small_map(2, sensor=SensorConfig(max_distance=1e6, exclusion=None, body=BodyConfig()))
    for _ in range(3):
        cloud = rng.normal(size=(2, 60, 3)) * 10.0 ** rng.integers(-6, 5, (2, 60, 1))
        cloud[rng.random((2, 60)) < 0.2] = rng.choice([np.nan, np.inf, -np.inf, 0.0])
        T = random_poses(rng, 2, tilt=3.0, reach=1.0)
        emap.update(torch.from_numpy(cloud).to(dtype), T, T if rng.random() < 0.7 else None, float(rng.random()))
        assert floats_finite(emap.state) == []
        assert (emap.variance > 0).all() and (emap.variance <= emap.cfg.fusion.max_variance).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_maps_of_half_precision_take_in_no_points(dtype):
    emap = small_map(B).to(dtype)
    before = snapshot(emap)
    for take_in in (emap.update, emap.measure):
        with pytest.raises(TypeError, match=f"map: must be float32 or float64.*got {dtype}; call .float"):
            take_in(torch.zeros(B, 5, 3), pose(num_envs=B))
    measurement = small_map(B).measure(torch.zeros(B, 5, 3), pose(num_envs=B), dt=0.0)
    with pytest.raises(TypeError, match="map: must be float32 or float64"):
        emap(emap.state, measurement)
    assert differences(before, emap.state) == []
    emap.float().update(torch.zeros(B, 5, 3), pose(num_envs=B), dt=0.0)


@given(st.integers(0, 10_000))
def test_every_point_is_counted_once(seed):
    rng = np.random.default_rng(seed)
    emap = small_map(2, sensor=SensorConfig(min_distance=0.5, max_distance=2.0, body=BodyConfig()))
    counters = [n for n in Statistics._fields if n == "points_used" or n.startswith("rejected")]
    for _ in range(2):
        T = random_poses(rng, 2, tilt=1.0)
        cloud = torch.from_numpy(rng.uniform(-1.5, 1.5, (2, 80, 3)))
        cloud[:, ::9] = torch.nan
        emap.update(cloud, T, T, 0.1)
        assert sum(getattr(emap.statistics, n) for n in counters).tolist() == [80, 80]


def test_checks_of_values_can_be_asked_for_on_other_devices():
    """On devices other than the CPU values are read on request only."""
    from torchelev.ops.transforms import is_readable

    assert is_readable(torch.zeros(1)) and not is_readable(torch.zeros(1, device=META))
    assert is_readable(torch.zeros(1, device=META), may_wait=True)


def test_a_map_of_nans_stays_blank(emap):
    fresh = small_map(B)
    fresh.update(nans(B), pose(num_envs=B), None, 0.0)
    assert not fresh.validity.any() and not fresh.bounded.any()
    assert fresh.statistics.rejected_invalid.tolist() == [4, 4]


@pytest.mark.parametrize("number", [np.int64, np.uint8, np.int32])
def test_numbers_of_numpy_count(number):
    emap = ElevationMap(small_config(), num_envs=number(2), chunk=number(1))
    assert (emap.num_envs, emap.chunk) == (2, 1) and type(emap.num_envs) is int
    for dt in (np.float32(0.5), np.float64(0.5), number(1)):
        emap.reset()
        cloud, T = scan(0)
        emap.update(cloud, T, T, dt=0.0)
        emap.update(cloud * torch.nan, T, T, dt)
        assert emap.layer("time").nan_to_num(-1).amax() == float(dt)


@pytest.mark.parametrize("number", [True, np.bool_(True), 2.0, np.float32(2), "2", 0, np.int64(0)])
def test_what_is_no_number_of_environments_is_refused(number):
    with pytest.raises(ValueError, match="num_envs: must be a positive int, got"):
        ElevationMap(small_config(), num_envs=number)
    with pytest.raises(ValueError, match="chunk: must be a positive int, got .*or None"):
        ElevationMap(small_config(), chunk=number)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("num_envs", [2, 20])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_numbers_in_a_pose_that_are_not_finite_are_refused_without_warnings(num_envs, bad):
    emap = small_map(num_envs)
    T = pose(num_envs=num_envs)
    T[-1, 0, 1] = bad
    with pytest.raises(ValueError, match=f"T_map_sensor: must be finite.*in environment {num_envs - 1}"):
        emap.update(torch.zeros(num_envs, 5, 3), T, None, 0.1)
