"""Updates that run out of memory."""

import numpy as np
import pytest
import torch

from tests.helpers import nans, pose, random_state, small_map
from tests.kernels.compare import clone, inputs_of, require_cpu_backend
from torchelev import ElevationMapConfig, pipeline
from torchelev.kernels.cpu_update import CpuUpdate, as_inputs
from torchelev.kernels.registry import Kernel
from torchelev.stages.disagreement.kernel import KERNEL as DISAGREEMENT
from torchelev.stages.measure.kernel import KERNEL as MEASURE

FAILING = """
#include <new>
#include "kernels/update.h"
extern "C" void run_fail(Update&) { throw std::bad_alloc(); }
"""


@pytest.fixture(scope="module")
def failing(tmp_path_factory):
    """A stage that runs out of memory."""
    folder = tmp_path_factory.mktemp("failing")
    (folder / "cpu.cpp").write_text(FAILING)
    return Kernel(name="failing", folder=str(folder), settings=lambda cfg: dict(unused=0))


@pytest.mark.slow(3)
@pytest.mark.parametrize("between", [(), ("add_disagreement",)], ids=["taken out", "put in again"])
def test_variances_keep_the_disagreement(between, failing):
    """It is taken out while the map's own cells are compared."""
    emap = require_cpu_backend(small_map(2))
    state = random_state(np.random.default_rng(0), emap.cfg.grid, 2, 0.6, torch.float32)
    state.variance.add_(1.0)
    state.statistics.disagreement.fill_(0.3)
    stages = CpuUpdate((MEASURE, DISAGREEMENT, failing), pipeline.TENSORS, (), emap.cfg, ElevationMapConfig())
    after, inputs = clone(state), inputs_of(emap, nans(2), pose(num_envs=2), None)
    values = as_inputs(inputs._asdict() | {"own": None})
    with pytest.raises(MemoryError, match="fewer or smaller maps"):
        order = "measure", "subtract_disagreement", *between, "fail"
        stages.run((*after[:-1], *after.statistics), values, order)
    torch.testing.assert_close(after.variance, state.variance)
