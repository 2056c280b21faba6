"""Boxes on terrain tiles: as rays see them, as ceilings, and as what bodies meet."""

import math

import pytest
import torch

from torchelev.sim import Box, DepthCamera, MountedSensor, Part, Scene, Structures, mount
from torchelev.sim import cast as cast_exactly
from torchelev.sim.sensors.casting import cast
from torchelev.sim.terrains import parts
from torchelev.sim.terrains.heightfield import HeightField

KINDS = [parts.table(), parts.beam(), parts.doorway(), parts.culvert(), parts.bridge()]
NAMES = ["table", "beam", "doorway", "culvert", "bridge"]
TILE = torch.zeros(1, dtype=torch.int64)


def flat(tiles=1):
    return HeightField(torch.zeros(tiles, 20, 20), 0.5)


def exact(structure):
    """The same boxes as an exact scene."""
    corners = [[[c + s * h for c, h in zip(part[0], part[1], strict=True)] for s in (-1, 1)] for part in structure]
    return Scene(boxes=tuple(Box(low=tuple(low), high=tuple(high)) for low, high in corners))


def rays(seed, count=300):
    rng = torch.Generator().manual_seed(seed)
    origin = torch.rand(3, generator=rng, dtype=torch.float64) * torch.tensor([6.0, 4.0, 1.5]) - torch.tensor([3, 2, 0])
    aim = torch.rand(count, 3, generator=rng, dtype=torch.float64) * torch.tensor([5.0, 3.0, 2.0])
    d = aim - torch.tensor([2.5, 1.5, 0.0]) - origin
    return origin, d / d.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("native", ["1", "0"])
@pytest.mark.parametrize("structure", KINDS, ids=NAMES)
def test_rays_hit_what_they_hit_in_the_exact_scene(structure, native, monkeypatch):
    monkeypatch.setenv("TORCHELEV_NATIVE", native)
    structures, scene = Structures.of_tiles([structure]), exact(structure)
    hits = 0
    for seed in range(4):
        origin, d = rays(seed)
        expected = cast_exactly(scene, origin, d, 8.0).nan_to_num(math.inf)
        got = cast(flat(), TILE, origin[None], d[None], 8.0, structures.boxes(TILE))[0]
        torch.testing.assert_close(got.double(), expected, atol=1e-4, rtol=0)
        ground = cast(flat(), TILE, origin[None], d[None], 8.0)[0]
        hits += int((got < ground - 1e-3).sum())
    assert hits > 30


def test_placed_structures_turn_and_move():
    yaw, (x, y, z) = 0.7, (1.5, -0.5, 0.25)
    R = torch.tensor([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]).double()
    deep = HeightField(torch.full((1, 4, 4), -9.0), 1.0)
    for structure in KINDS:
        origin, d = rays(5)
        here = cast(deep, TILE, origin[None], d[None], 6.0, Structures.of_tiles([structure]).boxes(TILE))
        moved = Structures.of_tiles([parts.placed(structure, x, y, z, yaw)]).boxes(TILE)
        there = cast(deep, TILE, (R @ origin + torch.tensor([x, y, z]))[None], (d @ R.T)[None], 6.0, moved)
        torch.testing.assert_close(there, here, atol=1e-4, rtol=0)


@pytest.mark.parametrize("native", ["1", "0"])
def test_only_boxes_within_reach_are_looked_at(native, monkeypatch):
    monkeypatch.setenv("TORCHELEV_NATIVE", native)
    long = Part((6.0, 0.0, 1.0), (4.0, 0.5, 0.5))  # its middle is out of reach, its face is not
    far = Part((0.0, 20.0, 1.0), (1.0, 1.0, 1.0))
    boxes = Structures.of_tiles([[far, long]]).boxes(TILE)
    d = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    got = cast(flat(), TILE, torch.tensor([[0.0, 0.0, 1.0]]), d, 5.0, boxes)[0]
    assert got.tolist() == [2.0, math.inf]


def test_each_environment_has_the_boxes_of_its_tile():
    structures = Structures.of_tiles([parts.table(0.5), []])
    camera = MountedSensor(DepthCamera(8, 8, 60.0, 60.0, max_range=4.0), mount(10.0))
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 0, 3], T[:, 2, 3] = -2.0, 0.3
    ids = torch.tensor([1, 0, 1])
    with_boxes = camera(flat(2), ids, T, structures.boxes(ids))
    without = camera(flat(2), ids, T)
    torch.testing.assert_close(with_boxes[[0, 2]], without[[0, 2]], atol=1e-4, rtol=0, equal_nan=True)
    assert not torch.equal(with_boxes[1].nan_to_num(), without[1].nan_to_num())


def test_ceilings_and_tops_are_those_of_the_exact_scene():
    for structure in KINDS:
        structures, scene = Structures.of_tiles([structure]), exact(structure)
        xy = torch.rand(1, 400, 2, dtype=torch.float64) * 6 - 3
        for height in (0.01, 0.3, 1.9):
            above = torch.full((1, 400), height, dtype=torch.float64)
            expected = scene.ceiling(xy[0], above[0]).float()
            torch.testing.assert_close(structures.underside(TILE, xy.float(), above.float())[0], expected)
    deck = Structures.of_tiles([parts.bridge(1.8, thickness=0.25)])
    place = torch.tensor([[[0.0, 0.0], [9.0, 0.0]]])
    assert deck.top(TILE, place, torch.full((1, 2), 2.2)).tolist() == [[pytest.approx(2.05), -math.inf]]
    assert deck.top(TILE, place, torch.full((1, 2), 2.0)).tolist() == [[-math.inf, -math.inf]]


def sampled(structures, xy, yaw, size, grow):
    """Whether a grid of points over a body lies in a box grown by `grow` [m]."""
    a, b = (torch.linspace(-0.5, 0.5, 61) * side for side in size)
    local = torch.stack(torch.meshgrid(a, b, indexing="ij"), -1).view(1, -1, 2)
    cos, sin = yaw.cos()[:, None], yaw.sin()[:, None]
    x, y = cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]
    half = structures.half_size + torch.tensor([grow, grow, 0.0])
    grown = Structures(structures.center, half, structures.yaw)
    places = xy[:, None] + torch.stack([x, y], -1)
    return grown.underside(TILE.expand(len(xy)), places, torch.full(places.shape[:2], 0.0)).isfinite().any(-1)


def test_bodies_meet_the_boxes_that_their_outlines_overlap():
    torch.manual_seed(0)
    structures = Structures.of_tiles([[Part((0.0, 0.0, 0.5), (0.6, 0.1, 0.1), 0.4)]])
    xy, yaw, size = torch.rand(300, 2) * 2 - 1, torch.rand(300) * 6, (0.6, 0.4)
    ids, zero = TILE.expand(300), torch.zeros(300)
    meets = structures.meets(ids, xy, yaw, size, zero, zero + 0.6)
    assert bool((meets | ~sampled(structures, xy, yaw, size, -0.01)).all())
    assert bool((~meets | sampled(structures, xy, yaw, size, 0.01)).all())
    assert 0.2 < float(meets.float().mean()) < 0.9
    assert not bool(structures.meets(ids, xy, yaw, size, zero, zero + 0.39).any()), "passes under it"
    assert not bool(structures.meets(ids, xy, yaw, size, zero + 0.61, zero + 1.0).any()), "stands on it"


def test_absent_boxes_are_met_by_nothing():
    absent = Structures.of_tiles([[], []])
    ids, here = torch.tensor([1]), torch.zeros(1, 2)
    assert not bool(absent.meets(ids, here, torch.zeros(1), (1.0, 1.0), torch.zeros(1), torch.ones(1)).any())
    assert absent.underside(ids, here[:, None], torch.full((1, 1), -1.0)).isinf().all()
    assert absent.top(ids, here[:, None], torch.ones(1, 1)).isinf().all()


def test_doors_and_tunnels_are_open_and_bridges_are_climbed_step_by_step():
    for structure, inside in ((parts.doorway(1.8, 0.9), 0.44), (parts.culvert(0.9, 1.2), 0.59)):
        boxes = Structures.of_tiles([structure])
        ids, yaw = TILE.expand(3), torch.zeros(3)
        y = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, inside]])
        top = torch.tensor([0.85, 2.0, 0.5])
        assert boxes.meets(ids, y, yaw, (0.1, 0.1), torch.zeros(3), top).tolist() == [False, True, True]
    x = torch.linspace(-8, 8, 321)
    xy = torch.stack([x, 0 * x], -1)[None]
    tops = Structures.of_tiles([parts.bridge()]).top(TILE, xy, torch.full((1, 321), 9.0)).clamp(min=0)[0]
    assert 0.1 < float(tops.diff().abs().max()) < 0.2 and float(tops.max()) == pytest.approx(2.05)


def test_bad_boxes_are_refused():
    with pytest.raises(ValueError, match="center, half_size, yaw: must be .*pad with half sizes of 0"):
        Structures(torch.zeros(1, 2, 3), torch.zeros(1, 3, 3), torch.zeros(1, 2))
    with pytest.raises(ValueError, match="tiles: must not be empty"):
        Structures.of_tiles([])
    with pytest.raises(ValueError, match="tiles: must be finite"):
        Structures.of_tiles([[Part((math.nan, 0.0, 0.0), (1.0, 1.0, 1.0))]])
    with pytest.raises(ValueError, match="height: must be a positive number, got -1"):
        parts.table(-1.0)
    with pytest.raises(ValueError, match="wall_height - height"):
        parts.doorway(2.5)
