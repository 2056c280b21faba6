"""What the real compiler makes of an update: the recorded answers, those of the eager update, the same graphs again.

All on one config, which is compiled once, in float32 and in float64: that takes a minute or two.
"""

import pytest
import torch

from tests.answers import PARTS, assert_recorded, config
from tests.helpers import assert_close, differences, pose, scan
from tests.inputs.test_update_inputs import assert_bad_poses_leave_one_robot_out
from torchelev import ElevationMap
from torchelev.compiled.kept_graphs import can_keep
from torchelev.compiled.update import Graphs
from torchelev.inputs import checks
from torchelev.stages.fusion import consensus, fuse
from torchelev.stages.fusion.consensus import resolve_contested

pytestmark = pytest.mark.compiles


@pytest.mark.slow(110)
@pytest.mark.parametrize("part", [part for part in PARTS if part.startswith("compiled")])
def test_answers_are_those_recorded(part):
    assert_recorded(part)


def graphs():
    """How many graphs were compiled so far."""
    return torch._dynamo.utils.counters["stats"]["unique_graphs"]


def assert_same(eager, compiled):
    """Of two states: equal but for rounding, the statistics too."""
    # The roughness of ground that few cells tell is the root of a rounding error.
    assert_close(eager, compiled, 1e-5, skip=["traversability"])
    torch.testing.assert_close(compiled.traversability, eager.traversability, atol=1e-3, rtol=0)
    floats = {n for n, v in eager._asdict().items() if n != "statistics" and v.is_floating_point()}
    heights = [name for name, value in eager.statistics._asdict().items() if value.is_floating_point()]
    for name in heights:
        pair = (getattr(state.statistics, name) for state in (compiled, eager))
        torch.testing.assert_close(*pair, atol=1e-5, rtol=1e-5)
    assert differences(eager, compiled, skip=floats | set(heights)) == []


def ring_seen_through():
    """A ring, then lower ground behind it, and then the same from another floor: clouds, poses and times between."""
    generator = torch.Generator().manual_seed(0)
    share, angle = torch.rand(2, 600, generator=generator), 6.2832 * torch.rand(2, 600, generator=generator)
    around = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    ring, ground = (around * (near + width * share)[..., None] for near, width in ((0.1, 0.1), (0.25, 0.25)))
    below, upstairs = pose(num_envs=2), pose((0.0, 0.0, 3.0), num_envs=2)
    yield ring + torch.tensor([0.0, 0.0, -0.4]), below, 0.3
    yield ground + torch.tensor([0.0, 0.0, -1.0]), below, 2.0
    yield ground * torch.nan, upstairs, 0.3


@pytest.mark.slow(5)
def test_compiled_update_equals_eager_and_shares_its_graphs(monkeypatch):
    """emap.compile() with the real compiler: results to rounding; no new graph for an equal config, N or slice.

    Nor for another number of contested cells: none, single ones, and tops and grounds of steps. The config is that of
    the recorded answers, whose graphs it shares.
    """
    sides = []

    def spy(points, *others):
        height, side = resolve_contested(points, *others)
        if not torch.compiler.is_compiling():
            sides.append([len(points.cells), int((side > 0).sum()), int((side < 0).sum())])
        return height, side

    monkeypatch.setattr(consensus, "resolve_contested", spy)
    monkeypatch.setattr(fuse, "can_update_in_cpp", lambda _: torch.compiler.is_compiling())  # the eager map by tensors
    maps = {name: ElevationMap(config(), 2) for name in ("eager", "compiled", "twin")}
    maps["compiled"].compile()
    maps["twin"].compile()
    cloud, T = scan(9)
    before = graphs()
    for emap in maps.values():
        emap.update(cloud, T, T, 0.3)
    # Kept graphs are compiled by another way, and nothing goes past them.
    assert graphs() - before in ((0,) if can_keep(torch.device("cpu")) else (0, len(Graphs._fields)))
    before = graphs()
    losses = {name: (torch.ones(1, requires_grad=True) * emap.elevation).sum() for name, emap in maps.items()}
    for k, number in enumerate((300, 290, 5000, 200, 6000, 100)):
        cloud, T = scan(k, 2, number)
        cloud = cloud[:, :150] if number == 200 else cloud
        T = T[:1].expand(2, 4, 4) if number == 200 else T
        if number == 6000:  # a block of heights in every cell
            T = pose(num_envs=2)
            generator = torch.Generator().manual_seed(0)
            cloud = torch.rand(2, 6000, 3, generator=generator) * torch.tensor([0.3, 0.3, 0.6])
            cloud = cloud - torch.tensor([0.15, 0.15, 1.15])
        cloud = cloud * torch.nan if number == 100 else cloud
        for emap in maps.values():
            emap.update(cloud, T, T, 0.3)
        for name in ("compiled", "twin"):
            assert_same(maps["eager"].state, maps[name].state)
    assert graphs() == before
    for loss in losses.values():
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            loss.backward()
    disputed, tops, grounds = zip(*sides, strict=True)
    assert 0 in disputed and max(disputed) > 10 and max(tops) > 0 and max(grounds) > 0


@pytest.mark.slow(5)
def test_compiled_update_clears_as_the_eager_one_does():
    eager, compiled = ElevationMap(config(), 2), ElevationMap(config(), 2)
    compiled.compile()
    by_rays = by_floor = 0
    for cloud, T, dt in ring_seen_through():
        for emap in (eager, compiled):
            emap.update(cloud, T, T, dt)
        assert_same(eager.state, compiled.state)
        by_rays += eager.statistics.cleared_seen_through.min()
        by_floor += eager.statistics.cleared_other_floors.min()
    assert by_rays > 0 and by_floor > 0


@pytest.mark.slow(1)
@pytest.mark.parametrize("of", ["sensor", "base", "both"])
def test_one_bad_pose_that_was_not_read_leaves_one_robot_out(of, monkeypatch):
    """As on a GPU, where the host does not wait to read it."""
    emap, eager = (ElevationMap(config(), 2) for _ in range(2))
    for k in range(2):
        cloud, T = scan(k)
        for one in (emap, eager):
            one.update(cloud, T, T, 0.3)
    emap.compile()
    monkeypatch.setattr(checks, "readable", lambda *_: False)
    assert_bad_poses_leave_one_robot_out(emap, eager, of)
