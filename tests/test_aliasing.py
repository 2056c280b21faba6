"""What the map returns shares no memory with its buffers, nor with what it was given."""

import itertools

import pytest
import torch
from torch import Tensor

from tests.helpers import mapped, pose, scan, small_map
from torchelev import BodyConfig, LearnedTraversabilityConfig, SensorConfig
from torchelev.filters.chain import FilterConfig
from torchelev.layers import LAYERS
from torchelev.planning.queries import height_profile, submap
from torchelev.stages.fusion.config import FusionConfig

OFF = {
    "drift": dict(drift=None),
    "raycast": dict(raycast=None),
    "overlap": dict(overlap=None),
    "traversability": dict(traversability=None),
    "edges": dict(fusion=FusionConfig(edges=None)),
    "exclusion": dict(sensor=SensorConfig(exclusion=None)),
}
STAGES = {" ".join(names) or "nothing": names for k in (0, 1, 4, 6) for names in itertools.combinations(OFF, k)}


def tensors(value):
    """All tensors in nested tuples, lists and dicts."""
    if isinstance(value, Tensor):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, tuple | list) else ()
    return [tensor for part in parts for tensor in tensors(part)]


def memory(*values):
    return {tensor.untyped_storage().data_ptr() for value in values for tensor in tensors(value)}


def assert_fresh(emap, result, *given):
    buffers = list(emap.buffers()) + list(emap.parameters())
    assert tensors(result) and not memory(result) & memory(buffers, *given)


@pytest.mark.slow(2)
@pytest.mark.parametrize("with_base", [True, False])
@pytest.mark.parametrize("off", STAGES)
@pytest.mark.parametrize("inference", [False, True])
def test_forward_and_measure_return_memory_of_their_own(off, with_base, inference):
    stages = {name: stage for switched in STAGES[off] for name, stage in OFF[switched].items()}
    emap = mapped(**stages)
    cloud, T = scan(7)
    inputs = (cloud, T, T.clone() if with_base else None, torch.full((2,), 0.1))
    variance = torch.full(cloud.shape[:-1], 1e-3) if with_base else None
    with torch.inference_mode(inference):
        m = emap.measure(*inputs, variance=variance)
        assert_fresh(emap, m, inputs, variance)
        for state in (emap.state, emap(emap.state, m)):
            after = emap(state, m)
            assert_fresh(emap, after, m, state)
            assert len(memory(after)) == len(tensors(after)), "layers of their own"


@pytest.mark.parametrize(
    "stages", [{}, dict(traversability=LearnedTraversabilityConfig()), dict(sensor=SensorConfig(body=BodyConfig()))]
)
def test_forward_with_other_stages(stages):
    emap = mapped(**stages)
    cloud, T = scan(7)
    for base in (T, None):
        m = emap.measure(cloud, T, base, dt=0.1)
        assert_fresh(emap, emap(emap.state, m), m, emap.state)
    assert_fresh(emap, emap.rate())


def test_a_kept_state_stays_when_the_map_moves():
    emap = mapped()
    cloud, T = scan(7)
    kept = emap(emap.state, emap.measure(cloud, T, None, dt=0.1))
    copy = kept.corner.clone(), kept.base_height.clone()
    far = pose((3.0, -2.0, 4.0), num_envs=2)
    emap.update(cloud, far, far, dt=0.1)
    assert torch.equal(kept.corner, copy[0]) and torch.equal(kept.base_height, copy[1])
    assert not torch.equal(emap.corner, copy[0])


@pytest.mark.parametrize("given", [True, False])
def test_readers_return_memory_of_their_own(given):
    emap = small_map(2, filters=(FilterConfig(layer="smooth", filter="box"),))
    cloud, T = scan(0)
    emap.update(cloud, T, T, dt=0.1)
    state = emap.state if given else None
    xy = torch.zeros(2, 1, 2)
    for name in (*LAYERS, "smooth"):
        for _ in range(2):  # the second time a filter's layer was kept
            kept = tensors([emap.read_layer("smooth")])
            assert_fresh(emap, emap.layer(name, state=state), kept)
            for mode in ("bilinear", "nearest"):
                assert_fresh(emap, emap.sample(xy, name, mode, state=state), kept, xy)
            part = submap(emap, xy[:, 0], 0.3, 0.2, [name], state=state)
            assert_fresh(emap, [part.layers, part.center], kept, xy)
    assert_fresh(emap, emap.rate(state=state))
    assert_fresh(emap, height_profile(emap, xy, xy + 0.1, 4, state=state), xy)
    assert_fresh(emap, [emap.center, emap.cell_centers(), emap.statistics])
