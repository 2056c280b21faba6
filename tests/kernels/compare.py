"""A stage run by C++ and by tensors on the same state and inputs."""

import functools
import tempfile
from pathlib import Path

import pytest
import torch

from tests.kernels.emulation.launcher import emulated, needs_emulation
from torchelev import ElevationMapConfig, pipeline
from torchelev.inputs.update_inputs import check_inputs
from torchelev.kernels.cpu_update import as_inputs, compiled_stages
from torchelev.kernels.cuda_update import CudaUpdate
from torchelev.kernels.registry import PACKAGE
from torchelev.stages.measure.stage import find_own, measure
from torchelev.state import map_layers

NAMES = [stage.name for stage in pipeline.STAGES]
# Roughness is a small difference of squares: float32 tensors are as far as this from float64 ones.
_ROUNDING = {"traversability": 1e-4}


def require_cpu_backend(emap):
    if emap.backend.name != "CPU":
        pytest.skip("needs a C++ compiler")
    return emap


def clone(state):
    return map_layers(torch.clone, state)


def inputs_of(emap, points, T_map_sensor, T_map_base, dt=0.3, variance=None, links=None, covariance=None, moving=None):
    return check_inputs(
        *(points, T_map_sensor, T_map_base, dt, variance, links, covariance, moving),
        *(emap.num_envs, emap.device, torch.float32, emap.cfg.sensor.links, False),
    )


def by_tensors(emap, state, inputs, name):
    cfg = emap.cfg
    m = measure(*inputs, cfg.grid, cfg.sensor, torch.float32)
    with torch.no_grad():
        return pipeline.STAGES[NAMES.index(name)].run(state, m, cfg)


def by_cpu(emap, state, inputs, *names):
    """Run stages after `measure` on a copy of the state."""
    after = clone(state)
    values = inputs._asdict() | {"own": find_own(inputs, emap.cfg.sensor)}
    stages = compiled_stages(pipeline.register_stages(emap.cfg))
    stages.run((*after[:-1], *after.statistics), as_inputs(values), ("measure", *names))
    return after


@functools.cache
def emulated_source(source):
    """A CUDA source with its headers, for the CPU."""
    folder = Path(tempfile.mkdtemp(prefix="torchelev-headers-"))
    for name, text in source.headers:
        (folder / name).write_text(text)
    return emulated(PACKAGE / source.path, [folder, PACKAGE])


def launch_emulated(source, kernel, blocks, threads, memory, update):
    if blocks:
        emulated_source(source)(kernel, blocks, threads, memory, update)


def by_cuda(emap, state, inputs, *names, processors=4):
    """Run stages after `measure` and `locate` on a copy of the state, by CUDA kernels on the CPU."""
    missing = [name for name in names if not any(name in kernel.cuda for kernel in pipeline.KERNELS)]
    if missing:
        pytest.skip(f"no CUDA kernels of {missing}")
    after = clone(state)
    values = inputs._asdict() | {"own": find_own(inputs, emap.cfg.sensor)}
    limits = {"processors": processors, "block_memory": 200_000}
    order = ("measure", *NAMES)
    kernels = pipeline.KERNELS, pipeline.TENSORS, order, emap.cfg, ElevationMapConfig(), launch_emulated
    update = CudaUpdate(*kernels, lambda device: limits)
    update.run((*after[:-1], *after.statistics), as_inputs(values), ("measure", "locate", *names))
    return after


BACKENDS = [pytest.param(by_cpu, id="CPU"), pytest.param(by_cuda, id="CUDA", marks=needs_emulation)]


def tensors_of(state):
    return {n: v for n, v in (state._asdict() | state.statistics._asdict()).items() if n != "statistics"}


def assert_states_close(actual, expected, what, tolerance=2e-6, share=0.002):
    """All but a few values agree to a tolerance, in shares of the layer's range: a rounding may decide the others."""
    wanted = tensors_of(expected)
    for name, value in tensors_of(actual).items():
        a, b = value.double(), wanted[name].double()
        if b.numel() == 0:
            continue
        span = max(float(b.max() - b.min()), 1e-3)
        differs = ((a - b).abs() > max(tolerance, _ROUNDING.get(name, 0.0)) * span) | (a.isnan() != b.isnan())
        worst = f"by up to {float((a - b).abs().max()):.3g}"
        assert differs.double().mean() <= share, f"{what}: {name} differs in {differs.double().mean():.2%}, {worst}"
