"""The models that are timed: each reads its map, and the table names all of them."""

import pytest
import torch
from tensordict import TensorDict

from benchmarks.speed import encoders


@pytest.mark.slow(1)
def test_every_model_reads_its_map_and_has_a_line():
    rows = encoders.measure(seconds=1e-3, num_envs=3)
    lines = encoders.table(rows).split("\n")
    assert [row["model"] for row in rows] == list(encoders.CASES) and len(lines) == 2 + len(rows)
    assert all(row["act"]["median"] > 0 and row["learn"]["median"] > 0 for row in rows)
    obs = TensorDict({name: torch.randn(3, *shape) for name, shape in encoders._SHAPES.items()}, batch_size=[3])
    for name, (_, group, _) in encoders.CASES.items():
        model, other = encoders.make_model(name, obs), obs.clone()
        other[group] = other[group] + 1.0
        assert not torch.equal(model(obs), model(other)), name
        assert f"{sum(p.numel() for p in model.parameters()):,}" in encoders.table(rows)
