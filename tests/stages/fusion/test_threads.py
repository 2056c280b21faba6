"""Clouds that several threads share."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.helpers import random_clouds, random_poses, random_state, small_map
from tests.kernels.compare import (
    assert_states_close,
    by_cpu,
    by_cuda,
    by_tensors,
    inputs_of,
    require_cpu_backend,
    tensors_of,
)
from tests.kernels.emulation.launcher import needs_emulation
from torchelev import pipeline
from torchelev.stages.fusion.kernel import KERNEL, MANY_POINTS, settings


def test_large_clouds_give_the_same_maps_on_any_number_of_threads():
    rng = np.random.default_rng(0)
    cells, num_points = (60, 80), 60_000
    emap = require_cpu_backend(small_map(1, cells))
    T = random_poses(rng, 1)[:, None]
    points = random_clouds(rng, T[:, 0], num_points, cells=cells)[:, None]
    state = random_state(rng, emap.cfg.grid, 1, 0.6, torch.float32)
    inputs = inputs_of(emap, points, T, None)
    after = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        after.append(by_cpu(emap, state, inputs, "fuse"))
    assert after[0].statistics.points_used > 0.1 * num_points
    assert_states_close(after[0], by_tensors(emap, state, inputs, "fuse"), "fuse", 1e-5)
    for other in after[1:]:
        for name, value in tensors_of(other).items():
            assert torch.equal(value, tensors_of(after[0])[name]), name


@needs_emulation
@pytest.mark.parametrize("many_points", [0, MANY_POINTS], ids=["eight threads", "a warp"])
def test_threads_of_a_gpu_share_cells_with_many_points(many_points, monkeypatch):
    kernel = dataclasses.replace(KERNEL, settings=lambda cfg: settings(cfg) | dict(many_points=many_points))
    monkeypatch.setattr(pipeline, "KERNELS", [kernel if k is KERNEL else k for k in pipeline.KERNELS])
    rng = np.random.default_rng(0)
    cells, num_points = (7, 9), 2500
    emap = small_map(1, cells)
    T = random_poses(rng, 1)[:, None]
    inputs = inputs_of(emap, random_clouds(rng, T[:, 0], num_points, cells=cells)[:, None], T, None)
    state = random_state(rng, emap.cfg.grid, 1, 0.6, torch.float32)
    after = by_cuda(emap, state, inputs, "fuse")
    assert after.statistics.points_used > 9 * emap.cfg.grid.num_cells
    assert_states_close(after, by_tensors(emap, state, inputs, "fuse"), "fuse", 1e-5)
