"""The contract of the module: state, reset, checkpoints, copies, inference mode, parts, precision, fake tensors."""

import copy
import dataclasses
import io
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

import torchelev
from tests.helpers import (
    assert_close,
    differences,
    mapped,
    nans,
    pose,
    scan,
    small_config,
    small_map,
    snapshot,
)
from torchelev import (
    AgingConfig,
    DriftConfig,
    ElevationMap,
    ElevationMapConfig,
    GridConfig,
    LearnedTraversabilityConfig,
    SensorConfig,
)
from torchelev.layers import LAYERS
from torchelev.state import Statistics


def round_trip(checkpoint):
    """Through a file, and read without trusting it."""
    file = io.BytesIO()
    torch.save(checkpoint, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


# Shapes and defaults --------------------------------------------------------------------------------------------------


def test_the_example_of_the_contract():
    cfg = ElevationMapConfig(grid=GridConfig(resolution=0.04, length_x=8.0, length_y=4.0))
    emap = ElevationMap(cfg, num_envs=2, device="cpu")
    cloud, T = scan(0)
    emap.update(cloud, T, T, dt=0.1)
    for name in LAYERS:
        layer = emap.layer(name)
        assert layer.shape == (2, 200, 100) and layer.dtype == torch.float32, name
    values, valid = emap.sample(torch.zeros(2, 7, 2), layer="elevation", mode="bilinear")
    assert values.shape == valid.shape == (2, 7) and valid.dtype == torch.bool
    assert emap.center.shape == (2, 3) and emap.cell_centers().shape == (2, 200, 100, 2)
    torch.testing.assert_close(emap.center[:, 2], T[:, 2, 3], atol=1e-6, rtol=0)
    for name in Statistics._fields:
        statistic = getattr(emap.statistics, name)
        assert statistic.shape == (2,), name
        assert statistic.dtype == (
            torch.float32 if name in ("drift_error", "drift_correction", "disagreement") else torch.int64
        )
    assert emap.statistics.points_used.min() > 0


def test_defaults_run_on_a_cube_of_points():
    emap = ElevationMap()
    emap.update(torch.rand(1, 100, 3) - torch.tensor([0.5, 0.5, 1.5]), pose(), pose(), 0.1)
    assert emap.layer("elevation").shape == (1, 250, 250) and emap.device.type == "cpu"


def test_everything_exported_exists():
    assert all(hasattr(torchelev, name) for name in torchelev.__all__)


def test_elevation_is_absolute():
    """Map frame: not relative to the robot, whatever its height."""
    emap = small_map(1)
    emap.update(torch.tensor([[[0.05, 0.05, -0.7]]]), pose((0, 0, 20.7)), pose((0, 0, 20.7)), dt=0.0)
    assert emap.layer("elevation")[emap.validity].item() == pytest.approx(20.0, abs=1e-5)
    assert emap.layer("elevation")[0, 6, 5].item() == pytest.approx(20.0, abs=1e-5)


# The core and its wrapper ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_base", [True, False])
def test_update_is_measure_forward_store(with_base):
    a, b = mapped(), mapped()
    cloud, T = scan(7)
    base = T if with_base else None
    before = snapshot(a)
    m = a.measure(cloud, T, base, 0.2)
    with_gradient = a(a.state, m)
    with torch.no_grad():
        state = a(a.state, m)
    assert differences(before, a.state) == []  # forward touches no buffer
    b.update(cloud, T, base, 0.2)
    assert_close(state, b.state, 1e-5, skip=["traversability"])
    assert_close(with_gradient, b.state, 1e-5, skip=["traversability"])  # the root of a rounding error, on a few cells


def test_forward_refuses_a_measurement_of_another_dtype():
    emap, (cloud, T) = mapped(), scan(7)
    m = small_map(2, dtype=torch.float64).measure(cloud, T, T, 0.2)
    with pytest.raises(TypeError, match="measurement.*dtype, torch.float32.*float64"):
        emap(emap.state, m)


def test_update_neither_changes_nor_keeps_its_arguments():
    emap = small_map(2)
    cloud, T = scan(0)
    dt, variance = torch.tensor([0.1, 0.2]), torch.full(cloud.shape[:2], 1e-3)
    arguments = (cloud, T, dt, variance)
    copies = [v.clone() for v in arguments]
    emap.update(cloud, T, T, dt, variance=variance)
    assert all(torch.equal(v, c) for v, c in zip(arguments, copies, strict=True))
    before = snapshot(emap)
    for v in arguments:
        v.fill_(torch.nan)
    assert differences(before, emap.state) == []


def test_an_environment_without_returns_only_ages():
    """A row of NaN leaves its map to the bit, but for its times and variance; the others are as if alone."""
    emap, alone = mapped(3, drift=None), mapped(3, drift=None)
    cloud, T = scan(9, 3)
    cloud[1] = torch.nan
    before = snapshot(emap)
    emap.update(cloud, T, None, 0.5)
    alone.update(scan(9, 3)[0], T, None, 0.5)
    rows = [n for n in before._fields[:-1] if not torch.equal(getattr(before, n)[1], getattr(emap.state, n)[1])]
    assert set(rows) == {"elapsed", "time", "variance"}
    known, growth = before.validity[1], emap.cfg.aging.variance_rate * 0.5
    torch.testing.assert_close(emap.time[1], before.time[1] + 0.5 * known)
    torch.testing.assert_close(emap.variance[1], (before.variance[1] + growth * known).clamp(max=1.0))
    for b in (0, 2):
        assert torch.equal(emap.layer("elevation")[b].nan_to_num(), alone.layer("elevation")[b].nan_to_num())
    assert emap.statistics.rejected_invalid.tolist() == [0, 300, 0] and emap.statistics.points_used[1] == 0


def test_sensors_of_one_instant_are_one_measurement():
    """(B, S, N, 3) with one pose for all sensors is the cloud of all points."""
    split, joined = small_map(2, raycast=None), small_map(2, raycast=None)
    for k in range(2):
        cloud, T = scan(k)
        split.update(cloud.unflatten(1, (3, 100)), T[:, None].repeat(1, 3, 1, 1), T, 0.2)
        joined.update(cloud, T, T, 0.2)
        assert_close(split.state, joined.state)
    assert split.statistics.points_used.tolist() == joined.statistics.points_used.tolist()


def test_each_sensor_stands_where_its_pose_says():
    emap = small_map(1, cells=(20, 20))
    T = torch.cat([pose((-0.5, 0, 1.0)), pose((0.5, 0, 2.0), yaw=np.pi)])[None]
    cloud = torch.zeros(1, 2, 1, 3)
    cloud[0, 0], cloud[0, 1] = torch.tensor([0.03, 0.03, -1.0]), torch.tensor([0.03, 0.03, -1.5])
    emap.update(cloud, T, dt=0.0)
    known = emap.validity[0].nonzero().tolist()
    assert known == [[5, 10], [14, 9]]
    torch.testing.assert_close(emap.elevation[0, 5, 10], torch.tensor(0.0), atol=1e-6, rtol=0)
    torch.testing.assert_close(emap.elevation[0, 14, 9], torch.tensor(0.5), atol=1e-6, rtol=0)


def test_a_further_sensor_of_the_same_instant_passes_no_time():
    emap = mapped(1, drift=None, raycast=None, aging=AgingConfig(variance_rate=0.01))
    cloud, T = scan(5, 1)
    before = snapshot(emap)
    emap.update(cloud, T, None, dt=0.0)
    untouched = emap.time > 0
    assert untouched.any() and (emap.time[~untouched] == 0).any()
    assert torch.equal(emap.time[untouched], before.time[untouched])
    emap.update(nans(1), T, None, dt=0.0)
    emap.update(nans(1), T, None, dt=0.25)
    torch.testing.assert_close(emap.time[untouched], before.time[untouched] + 0.25)


def test_dt_as_tensor_and_as_number_agree():
    maps = [mapped() for _ in range(4)]
    cloud, T = scan(3)
    for emap, dt in zip(
        maps, (0.5, torch.tensor(0.5), torch.full((2,), 0.5), torch.full((2,), 0.5).double()), strict=True
    ):
        emap.update(cloud, T, T, dt)
        assert differences(maps[0].state, emap.state) == []
    maps[0].update(cloud, T, T, 1)  # an int is a number


def test_statistics_are_of_the_last_update():
    emap = mapped(2)
    emap.update(nans(2, 5), pose(num_envs=2), pose(num_envs=2), 0.1)
    statistics = emap.statistics._asdict()
    assert statistics.pop("rejected_invalid").tolist() == [5, 5]
    statistics.pop("cells_bounded")
    assert {n: v.tolist() for n, v in statistics.items() if v.any()} == {}


# Reset ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, which",
    [
        ({}, [True, True, True]),
        (dict(env_ids=torch.tensor([2, 0])), [True, False, True]),
        (dict(env_ids=torch.tensor([1])), [False, True, False]),
        (dict(env_ids=torch.zeros(0, dtype=torch.int64)), [False, False, False]),
        (dict(mask=torch.tensor([False, True, True])), [False, True, True]),
        (dict(mask=torch.zeros(3, dtype=torch.bool)), [False, False, False]),
    ],
)
def test_reset_equals_construction_and_leaves_the_others(arguments, which):
    emap, fresh = mapped(3), small_map(3)
    before = snapshot(emap)
    emap.reset(**arguments)
    for b, cleared in enumerate(which):
        expected = fresh.state if cleared else before
        for name in expected._fields[:-1]:
            assert torch.equal(getattr(emap.state, name)[b], getattr(expected, name)[b]), name
        for name in Statistics._fields:
            assert torch.equal(getattr(emap.statistics, name)[b], getattr(expected.statistics, name)[b]), name


def test_a_reset_map_maps_like_a_new_one():
    emap, fresh = mapped(2), small_map(2)
    emap.reset(mask=torch.ones(2, dtype=torch.bool))
    cloud, T = scan(4)
    for m in (emap, fresh):
        m.update(cloud, T, T, 0.1)
    assert differences(emap.state, fresh.state) == []


def test_inference_mode_then_reset_outside():
    """rsl-rl steps environments in inference mode and resets them outside."""
    emap = small_map(2)
    cloud, T = scan(0)
    with torch.inference_mode():
        emap.update(cloud, T, T, 0.1)
        emap.sample(torch.zeros(2, 3, 2))
        emap.reset(mask=torch.tensor([True, False]))
        emap.initialize(torch.zeros(2, 4, 3), method="nearest")
    assert not any(b.is_inference() for b in emap.buffers())
    emap.reset(torch.tensor([0]))
    emap.update(cloud, T, T, 0.1)
    emap.elevation.add_(0.0)
    assert emap.validity.any()


def test_a_map_made_in_inference_mode_can_be_used_outside():
    with torch.inference_mode():
        emap = small_map(2, traversability=LearnedTraversabilityConfig())
    assert not any(b.is_inference() for b in emap.state_dict().values() if isinstance(b, torch.Tensor))
    cloud, T = scan(0)
    emap.update(cloud, T, T, 0.1)
    assert emap.validity.any()
    emap.reset()
    assert not emap.validity.any()


@pytest.mark.parametrize("chunk", [None, 1])
def test_an_update_stops_a_backward_pass_through_the_values_before(chunk):
    """Else its gradient would be that of the new values, unseen."""
    emap, weight = small_map(2), torch.ones(2, 1, 1, requires_grad=True)
    emap.chunk = chunk
    loss = (weight * emap.elevation).sum()
    cloud, T = scan(1)
    emap.update(cloud, T, T, 0.1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_buffers_keep_their_place_in_memory():
    """Whoever holds a buffer, such as a CUDA graph, sees the map change."""
    emap = small_map(2)
    places = {name: b.data_ptr() for name, b in emap.named_buffers()}
    cloud, T = scan(0)
    emap.update(cloud, T, T, 0.1)
    emap.reset(mask=torch.tensor([True, False]))
    emap.initialize(torch.zeros(2, 4, 3), method="nearest")
    assert {name: b.data_ptr() for name, b in emap.named_buffers()} == places


# Copies and checkpoints -----------------------------------------------------------------------------------------------


def test_state_dict_round_trip():
    emap, other = mapped(), small_map(2)
    other.load_state_dict(round_trip(emap.state_dict()))
    statistics = set(Statistics._fields)
    assert differences(emap.state, other.state, skip=statistics) == []
    cloud, T = scan(8)
    for m in (emap, other):
        m.update(cloud, T, T, 0.1)
    assert differences(emap.state, other.state) == []


def test_the_config_comes_back_from_a_checkpoint():
    checkpoint = round_trip(mapped(sensor=SensorConfig(body=torchelev.BodyConfig())).state_dict())
    cfg = ElevationMapConfig.from_dict(checkpoint["_extra_state"]["config"])
    assert cfg == small_config(sensor=SensorConfig(body=torchelev.BodyConfig()))
    ElevationMap(cfg, num_envs=2).load_state_dict(checkpoint)


@pytest.mark.parametrize(
    "cells, stages, named",
    [
        ((12, 10), dict(drift=DriftConfig(gain=0.5)), "drift.gain"),
        ((12, 10), dict(drift=None), "drift"),
        ((12, 10), dict(sensor=SensorConfig(max_distance=9.0)), "sensor.max_distance"),
        ((13, 10), {}, "grid.length_x"),
    ],
)
def test_a_checkpoint_of_another_config_is_refused(cells, stages, named):
    emap = small_map(2, cells, **stages)
    with pytest.raises(ValueError, match=f"other {named}"):
        emap.load_state_dict(mapped().state_dict())


def test_a_refused_checkpoint_changes_nothing():
    emap = mapped(drift=DriftConfig(gain=0.5))
    before = snapshot(emap)
    with pytest.raises(ValueError, match="drift.gain"):
        emap.load_state_dict(mapped(scans=3).state_dict())
    assert differences(before, emap.state) == []


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_copies_are_independent(duplicate):
    emap = mapped()
    twin = duplicate(emap)
    assert twin.cfg == emap.cfg and differences(emap.state, twin.state) == []
    before = snapshot(emap)
    cloud, T = scan(6)
    twin.update(cloud, T, T, 0.1)
    assert differences(before, emap.state) == [] and differences(before, twin.state) != []


def test_deepcopy_after_gradients_flowed():
    emap = mapped()
    cloud, T = scan(6)
    cloud.requires_grad_()
    emap.update(cloud, T, T, 0.1)
    state = emap(emap.state, emap.measure(cloud, T, T, 0.1))
    state.elevation.sum().backward()
    twin = copy.deepcopy(emap)
    assert differences(emap.state, twin.state) == [] and not any(b.requires_grad for b in emap.buffers())


def test_a_map_inside_another_module():
    """As part of a policy: .to(dtype), state_dict with a prefix, no parameters."""
    policy = torch.nn.ModuleDict({"map": mapped()}).double()
    assert policy["map"].elevation.dtype == torch.float64 and policy["map"].corner.dtype == torch.int64
    assert list(policy.parameters()) == [] and "map.elevation" in policy.state_dict()
    cloud, T = scan(3)
    policy["map"].update(cloud, T, T, 0.1)


# Parts, precision, fake tensors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [1, 2, 3, 5])
def test_chunks_change_nothing(chunk):
    whole, parts = small_map(5), ElevationMap(small_config(), num_envs=5, chunk=chunk)
    for k in range(3):
        cloud, T = scan(k, 5)
        for emap in (whole, parts):
            emap.update(cloud, T, T, torch.arange(5.0), variance=torch.full(cloud.shape[:2], 1e-4))
    assert differences(whole.state, parts.state) == []


def test_same_clouds_same_map_to_the_bit():
    """On a CPU, with several threads; sums do not depend on which thread was first."""
    torch.set_num_threads(2)
    runs = []
    for _ in range(2):
        emap = small_map(3, (60, 50))
        for k in range(3):
            cloud, T = scan(k, 3, 20_000)
            emap.update(cloud, T, T, 0.1)
        runs.append(emap.state)
    assert differences(*runs) == []


@pytest.mark.parametrize("dtype, tolerance", [(torch.float16, 2e-3), (torch.bfloat16, 2e-2)])
def test_points_of_half_the_bytes(dtype, tolerance):
    """Points of half precision are the same points, rounded: within 2 m, by 1 mm, or by 8 mm in bfloat16."""
    maps = [small_map(2), small_map(2)]
    for k in range(3):
        cloud, T = scan(k, 2)
        maps[0].update(cloud.to(dtype).float(), T, T, 0.1)
        maps[1].update(cloud.to(dtype), T, T, 0.1)
    assert differences(maps[0].state, maps[1].state) == []
    exact = small_map(2)
    for k in range(3):
        cloud, T = scan(k, 2)
        exact.update(cloud, T, T, 0.1)
    both = exact.validity & maps[1].validity
    error = (exact.elevation - maps[1].elevation)[both].abs()
    assert both.float().mean() > 0.9 * exact.validity.float().mean() and error.median() < tolerance


@pytest.mark.slow(2)
@pytest.mark.parametrize("with_base", [True, False])
@pytest.mark.parametrize("sensors", [None, 2])
def test_nothing_waits_for_the_device(with_base, sensors):
    """Fake tensors hold no data: whatever needs a value on the host, or a data-dependent shape, raises."""
    with FakeTensorMode():
        emap = ElevationMap(small_config(sensor=SensorConfig(body=torchelev.BodyConfig())), num_envs=2)
        cloud, T = torch.zeros(2, 50, 3), torch.zeros(2, 4, 4, dtype=torch.float64)
        base = T if with_base else None
        if sensors:
            cloud, T = cloud.unflatten(1, (2, 25)), T[:, None].repeat(1, 2, 1, 1)
        emap.update(cloud, T, base, torch.zeros(2))
        emap.update(cloud, T, base, torch.zeros(2), variance=torch.ones(cloud.shape[:-1]))
        emap.update(cloud, T, base, 0.1)
        emap.reset(mask=torch.zeros(2, dtype=torch.bool))
        emap.reset()
        for name in LAYERS:
            assert emap.layer(name).shape == (2, 12, 10)
        for mode in ("bilinear", "nearest"):
            assert emap.sample(torch.zeros(2, 5, 2), mode=mode)[0].shape == (2, 5)
        assert emap.cell_centers().shape == (2, 12, 10, 2) and emap.center.shape == (2, 3)
        emap.initialize(torch.zeros(2, 4, 3), method="nearest")


def test_fake_tensors_do_catch_a_host_sync():
    with FakeTensorMode(), pytest.raises(Exception, match="local_scalar_dense"):
        bool(torch.zeros(2).any())


@pytest.mark.slow(1)
def test_a_map_on_the_meta_device():
    """Shapes without memory; a stand-in for any device that is not the CPU."""
    emap = ElevationMap(small_config(), num_envs=2, device="meta")
    assert emap.device.type == "meta" and emap.layer("elevation").shape == (2, 12, 10)
    with pytest.raises(ValueError, match="points: must be on meta"):
        emap.update(*scan(0), dt=0.0)
    cloud, T = (v.to("meta") for v in scan(0))
    emap.update(cloud, T, T, 0.1)


def test_every_stage_can_be_switched_off():
    off = dict(drift=None, raycast=None, overlap=None, traversability=None)
    off |= dict(fusion=dataclasses.replace(ElevationMapConfig().fusion, edges=None))
    for chosen in ({}, off, *({name: value} for name, value in off.items())):
        assert mapped(1, **chosen).layer("elevation").isfinite().any()


@pytest.mark.slow(1)
def test_importing_does_not_load_the_compiler():
    """Which takes a second; only compiled maps need it."""
    code = (
        "import sys, torch; before = 'torch._inductor' in sys.modules; import torchelev; "
        "assert before or 'torch._inductor' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
