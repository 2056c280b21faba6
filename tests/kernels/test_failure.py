"""Updates that run out of memory."""

import numpy as np
import pytest
import torch

from tests.helpers import nans, pose, random_state, small_map
from tests.kernels.compare import clone, inputs_of, require_cpu_backend
from torchelev import ElevationMapConfig, pipeline
from torchelev.kernels.cpu_update import CpuUpdate, as_inputs
from torchelev.kernels.registry import Kernel

FAILING = """
#include <new>
#include "kernels/update.h"
extern "C" void run_fail(Update&) { throw std::bad_alloc(); }
"""


@pytest.mark.parametrize("between", [(), ("add_disagreement",)], ids=["taken out", "put in again"])
def test_variances_keep_the_disagreement(between, tmp_path):
    """It is taken out while the map's own cells are compared."""
    (tmp_path / "cpu.cpp").write_text(FAILING)
    failing = Kernel(name="failing", folder=str(tmp_path), settings=lambda cfg: dict(unused=0))
    emap = require_cpu_backend(small_map(2))
    state = random_state(np.random.default_rng(0), emap.cfg.grid, 2, 0.6, torch.float32)
    state.variance.add_(1.0)
    state.statistics.disagreement.fill_(0.3)
    stages = (*pipeline.KERNELS, failing), pipeline.TENSORS, (), emap.cfg, ElevationMapConfig()
    after, inputs = clone(state), inputs_of(emap, nans(2), pose(num_envs=2), None)
    values = as_inputs(inputs._asdict() | {"own": None})
    with pytest.raises(MemoryError, match="fewer or smaller maps"):
        order = "measure", "subtract_disagreement", *between, "fail"
        CpuUpdate(*stages).run((*after[:-1], *after.statistics), values, order)
    torch.testing.assert_close(after.variance, state.variance)
