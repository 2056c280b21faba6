"""Each stage by C++ against its definition by tensors: along walks of several configs, and on random maps."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torchelev as te
from tests.answers import config, scans
from tests.helpers import random_clouds, random_poses, random_state, small_map
from tests.kernels.compare import (
    BACKENDS,
    NAMES,
    assert_states_close,
    by_tensors,
    clone,
    inputs_of,
    require_cpu_backend,
)
from torchelev import pipeline

CONFIGS = {
    "default": {},
    "without stages": dict(drift=None, raycast=None, overlap=None, traversability=None),
    "without edges": dict(fusion=te.FusionConfig(edges=None)),
    "wide surface": dict(surface=te.SurfaceConfig(radius=2)),
    "learned": dict(traversability=te.LearnedTraversabilityConfig()),
}


def walk(emap):
    """Inputs of all kinds along a walk."""
    torch.manual_seed(0)
    for k, (points, T_map_sensor, T_map_base) in enumerate(scans(8)):
        variance = 1e-4 + 1e-4 * torch.rand(points.shape[:-1]) if k % 3 == 1 else None
        covariance = 1e-4 * torch.eye(6).expand(2, 6, 6) if k % 3 == 2 else None
        base = None if k == 5 else T_map_base
        yield inputs_of(emap, points, T_map_sensor, base, 0.3, variance, None, covariance)


@pytest.mark.slow(26)
@pytest.mark.parametrize("stages", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("run", BACKENDS)
def test_each_stage_along_a_walk(run, stages):
    emap = require_cpu_backend(te.ElevationMap(config(**stages), 2))
    state = clone(emap.state)
    for k, inputs in enumerate(walk(emap)):
        if k == 7:
            state.elevation[:, 13:16, 10:14] += 3.0  # another floor
        for stage in NAMES:
            after = by_tensors(emap, state, inputs, stage)
            assert_states_close(run(emap, state, inputs, stage), after, f"scan {k}, {stage}")
            state = after
        state = clone(pipeline.rate_learned(state, emap.cfg, emap._weights))


SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40)) | st.sampled_from([(70, 19), (66, 150), (1, 300)])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("run", BACKENDS)
@given(
    st.integers(0, 10_000),
    SIZES,
    st.integers(1, 3),
    st.sampled_from([0, 1, 40, 700]),
    st.integers(1, 2),
    st.sampled_from([0.0, 0.1, 0.6, 1.0]),
)
def test_stage_on_random_maps(run, name, seed, cells, sensors, num_points, threads, known):
    rng = np.random.default_rng(seed)
    radius, reach = int(rng.integers(1, 4)), float(rng.choice([0.1, 0.2, 0.5]))
    heads = te.TraversabilityConfig(radius=reach), None
    stages = dict(surface=te.SurfaceConfig(radius=radius), traversability=heads[int(rng.random() < 0.2)])
    emap = require_cpu_backend(small_map(2, cells, overlap=te.OverlapConfig(radius=1.0, height=0.3), **stages))
    T = torch.stack([random_poses(rng, 2) for _ in range(sensors)], 1)
    clouds = [random_clouds(rng, T[:, k], num_points, cells=cells) for k in range(sensors)]
    points = torch.stack(clouds, 1) if num_points else torch.zeros(2, sensors, 0, 3)
    base = random_poses(rng, 2) if rng.random() < 0.8 else None
    inputs = inputs_of(emap, points, T, base)
    state = random_state(rng, emap.cfg.grid, 2, known, torch.float32)
    state.time.mul_(torch.from_numpy(rng.random(state.time.shape) < 0.7))
    torch.set_num_threads(threads)
    expected = by_tensors(emap, state, inputs, name)
    # A coin that a rounding tosses is one of few cells here.
    share = 0.002 + 2 / state.elevation[0].numel()
    assert_states_close(run(emap, state, inputs, name), expected, name, 1e-5, share)


@pytest.mark.slow(1)
@pytest.mark.parametrize("stages", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("num_threads", [1, 2])
def test_update(stages, num_threads):
    emap = require_cpu_backend(te.ElevationMap(config(**stages), 2))
    expected = clone(emap.state)
    torch.set_num_threads(num_threads)
    for points, T_map_sensor, T_map_base in scans(6):
        emap.update(points, T_map_sensor, T_map_base, dt=0.3)
        inputs = inputs_of(emap, points, T_map_sensor, T_map_base)
        with torch.no_grad():
            pipeline.update_by_tensors(expected, inputs, emap.cfg, emap._weights)
        assert_states_close(emap.state, expected, "update")
        expected = clone(emap.state)


def test_settings_keep_their_layout():
    """Whole numbers that a user gives for floats change no struct."""
    cfg = config(drift=te.DriftConfig(max_drift=1, gain=1), fusion=te.FusionConfig(gate=3, max_variance=1))
    cfg = dataclasses.replace(cfg, sensor=te.SensorConfig(min_distance=1, max_distance=50))
    for kernel in pipeline.KERNELS:
        own, default = kernel.settings(cfg), kernel.settings(te.ElevationMapConfig())
        kinds = [{k: type(v[0] if isinstance(v, tuple) else v) for k, v in s.items()} for s in (own, default)]
        assert kinds[0] == kinds[1], kernel.name


def test_numbers_of_other_types_mean_the_same():
    """Floats for whole numbers, as files of settings may have them, and whole numbers for floats."""
    odd = dict(surface=te.SurfaceConfig(radius=2.0), drift=te.DriftConfig(min_points=40.0, max_drift=1))
    usual = dict(surface=te.SurfaceConfig(radius=2), drift=te.DriftConfig(min_points=40, max_drift=1.0))
    states = []
    for stages in (odd, usual):
        emap = require_cpu_backend(te.ElevationMap(config(**stages), 2))
        for points, T_map_sensor, T_map_base in scans(3):
            emap.update(points, T_map_sensor, T_map_base, dt=0.3)
        states.append(emap.state)
    assert_states_close(states[0], states[1], "types", 0, 0)
