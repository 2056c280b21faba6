"""Normals and ratings by C++ against tensors, where cells are no longer known."""

import torch

from tests.helpers import small_map
from tests.kernels.compare import assert_states_close, by_cpu, by_tensors, clone, inputs_of, require_cpu_backend


def test_forgotten_cells():
    """Cells that are no longer known lose normal and rating, in rows without any known cell too."""
    emap = require_cpu_backend(small_map(1, (20, 20)))
    state = clone(emap.state)
    state.validity.fill_(True)
    T = torch.eye(4, dtype=torch.float64)[None]
    inputs = inputs_of(emap, torch.zeros(1, 1, 3), T, T)
    state = by_tensors(emap, state, inputs, "rate_surface")
    assert state.has_normal.all() and state.rated.all()
    state.validity[:, 4:] = False
    expected = by_tensors(emap, state, inputs, "rate_surface")
    assert not expected.has_normal[:, 4:].any()
    assert_states_close(by_cpu(emap, state, inputs, "rate_surface"), expected, "forgotten")
