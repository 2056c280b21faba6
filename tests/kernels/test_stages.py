"""Each stage by C++ against its definition by tensors, one after the other along walks of several configs."""

import dataclasses

import pytest
import torch

import torchelev as te
from tests.answers import config, scans
from torchelev import pipeline
from torchelev.inputs.update_inputs import check_inputs
from torchelev.kernels.choose import choose
from torchelev.kernels.cpu_update import as_inputs
from torchelev.stages.measure.stage import find_own, measure
from torchelev.state import map_layers

CONFIGS = {
    "default": {},
    "without stages": dict(drift=None, raycast=None, overlap=None, traversability=None),
    "without edges": dict(fusion=te.FusionConfig(edges=None)),
    "wide surface": dict(surface=te.SurfaceConfig(radius=2)),
    "learned": dict(traversability=te.LearnedTraversabilityConfig()),
}
NAMES = [stage.name for stage in pipeline.STAGES]
TINY = 1e-12


def make_map(**stages):
    emap = te.ElevationMap(config(**stages), 2)
    if choose(emap.elevation).name != "CPU":
        pytest.skip("needs a C++ compiler")
    return emap


def clone(state):
    return map_layers(torch.clone, state)


def run_on_cpu(emap, state, inputs, names):
    values = inputs._asdict() | {"own": find_own(inputs, emap.cfg.sensor)}
    pipeline.cpu_update(emap._update_cfg)(names, (*state[:-1], *state.statistics), as_inputs(values))


def assert_states_close(actual, expected, what):
    for name, value in (actual._asdict() | actual.statistics._asdict()).items():
        if name == "statistics":
            continue
        wanted = getattr(expected, name) if hasattr(expected, name) else getattr(expected.statistics, name)
        a, b = value.double(), wanted.double()
        span = max(float(b.max() - b.min()), 1e-3) if b.numel() else 1.0
        share = ((a - b).abs() > 2e-6 * span + TINY).double().mean() if b.numel() else 0.0
        assert share <= 0.002, f"{what}: {name} differs in {share:.2%}, by up to {(a - b).abs().max():.3g}"


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("stages", CONFIGS.values(), ids=CONFIGS)
def test_stage(stages, name):
    emap = make_map(**stages)
    cfg, number = emap._update_cfg, NAMES.index(name)
    state = clone(emap.state)
    torch.manual_seed(0)
    for k, (points, T_map_sensor, T_map_base) in enumerate(scans(8)):
        if k == 7:
            state.elevation[:, 13:16, 10:14] += 3.0  # another floor
        variance = 1e-4 + 1e-4 * torch.rand(points.shape[:-1]) if k % 3 == 1 else None
        covariance = 1e-4 * torch.eye(6).expand(2, 6, 6) if k % 3 == 2 else None
        of_map = (2, emap.device, torch.float32, (), False)
        base = None if k == 5 else T_map_base
        inputs = check_inputs(points, T_map_sensor, base, 0.3, variance, None, covariance, *of_map)
        m = measure(*inputs, cfg.grid, cfg.sensor, torch.float32)
        with torch.no_grad():
            for stage in pipeline.STAGES[:number]:
                state = stage.run(state, m, cfg)
            actual = clone(state)
            run_on_cpu(emap, actual, inputs, ("measure", name))
            state = pipeline.STAGES[number].run(state, m, cfg)
            assert_states_close(actual, state, f"scan {k}, {name}")
            for stage in pipeline.STAGES[number + 1 :]:
                state = stage.run(state, m, cfg)
            state = clone(pipeline.rate_learned(state, cfg, emap._weights))


@pytest.mark.parametrize("stages", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("num_threads", [1, 2])
def test_update(stages, num_threads):
    emap = make_map(**stages)
    expected = clone(emap.state)
    weights = emap._weights
    before = torch.get_num_threads()
    torch.set_num_threads(num_threads)
    try:
        for points, T_map_sensor, T_map_base in scans(6):
            emap.update(points, T_map_sensor, T_map_base, dt=0.3)
            inputs = check_inputs(
                points, T_map_sensor, T_map_base, 0.3, None, None, None, 2, emap.device, torch.float32, (), False
            )
            with torch.no_grad():
                pipeline.update_by_tensors(expected, inputs, emap._update_cfg, weights)
            assert_states_close(emap.state, expected, "update")
            expected = clone(emap.state)
    finally:
        torch.set_num_threads(before)


def test_settings_of_equal_layout():
    """Whole numbers that a user gives for floats change no struct."""
    cfg = config(drift=te.DriftConfig(max_drift=1, gain=1), fusion=te.FusionConfig(gate=3, max_variance=1))
    cfg = dataclasses.replace(cfg, sensor=te.SensorConfig(min_distance=1, max_distance=50))
    for kernel in pipeline.KERNELS:
        own, default = kernel.settings(cfg), kernel.settings(te.ElevationMapConfig())
        kinds = [{k: type(v[0] if isinstance(v, tuple) else v) for k, v in s.items()} for s in (own, default)]
        assert kinds[0] == kinds[1], kernel.name
