"""The terms for Isaac Lab and mjlab: right heights, each environment's own map, and resets."""

import importlib
import sys
from pathlib import Path

import pytest
import torch

EXAMPLES = str(Path(__file__).parents[2] / "examples")


@pytest.fixture(scope="module")
def walked():
    """The environment and both terms after a walk."""
    sys.path.insert(0, EXAMPLES)
    try:
        env = importlib.import_module("stand_ins").Environment(num_envs=3)
        configs = [importlib.import_module(name).MAP_SCAN for name in ("isaac_lab_term", "mjlab_term")]
    finally:
        sys.path.remove(EXAMPLES)
    terms = [cfg.func(cfg, env) for cfg in configs]
    for _ in range(15):
        env.step()
        values = [term(env, **cfg.params) for term, cfg in zip(terms, configs, strict=True)]
    return env, terms, values


@pytest.mark.slow(4)
def test_maps_are_right_in_the_world(walked):
    env, terms, _ = walked
    for term in terms:
        xy = term.emap.cell_centers().flatten(1, 2)
        truth = env.terrain.truth(env.tile_ids, (xy - env.origins[:, None, :2]).float())
        error = (term.emap.layer("elevation").flatten(1) - truth).abs()
        known = error.isfinite()
        assert (known.float().mean(1) > 0.1).all()
        assert (error.nan_to_num(0.0).sum(1) / known.sum(1) < 0.01).all()


@pytest.mark.slow(1)
def test_values_are_those_of_the_simulators(walked):
    env, _, (isaac, mjlab) = walked
    assert isaac.shape == mjlab.shape == (3, 187)
    # The same ground in both: base - elevation - 0.5, clipped to 1, and (base - elevation) / 5.
    torch.testing.assert_close(isaac, (5 * mjlab - 0.5).clamp(-1, 1), atol=0.02, rtol=0)


@pytest.mark.slow(1)
def test_resets_forget_only_the_given_environments(walked):
    for term in walked[1]:
        known = term.emap.layer("validity").sum((1, 2))
        term.reset(env_ids=torch.tensor([0, 2]))
        assert term.emap.layer("validity").sum((1, 2)).tolist() == [0, known[1], 0]
        term.reset()
        assert not term.emap.layer("validity").any()
