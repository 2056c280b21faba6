"""Ray casting against closed forms and against a fine march, on terrain that is hard on rays."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.helpers import rotation
from tests.test_gpu import OneDevice, needs_gpu
from torchelev.sim.sensors import tracing
from torchelev.sim.sensors.casting import Boxes, cast
from torchelev.sim.terrains.heightfield import HeightField

FINE = 5e-4  # [m] step of the march
PATHS = ["selects rays", "keeps all rays"]  # what a CPU does, and what a GPU does


@pytest.fixture(params=PATHS)
def path(request, monkeypatch):
    if request.param == PATHS[1]:
        monkeypatch.setattr(tracing, "can_select_rays", lambda device: False)
    return request.param


def one(field, origin, directions, max_range=10.0, boxes=None, tile=0):
    """Cast rays (M, 3), of any length, from one origin."""
    directions = torch.as_tensor(directions, dtype=torch.float64).view(1, -1, 3)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return cast(field, torch.tensor([tile]), torch.tensor([origin]), directions, max_range, boxes)[0]


def flat(height=0.0, size=20, resolution=0.05):
    return HeightField(torch.full((1, size, size), height), resolution)


# Closed forms ---------------------------------------------------------------------------------------------------------


def unit(rng, *shape):
    d = rng.normal(size=(*shape, 3))
    return torch.from_numpy(d / np.linalg.norm(d, axis=-1, keepdims=True))


def test_flat_ground(path):
    d = unit(np.random.default_rng(0), 500)
    expected = torch.where(d[:, 2] < -0.08, 0.7 / -d[:, 2], math.inf).float()  # 0.7 / 0.08 = 8.75: none is near the end
    far = d[:, 2].abs() > 0.08
    torch.testing.assert_close(one(flat(0.2), (0.1, -0.3, 0.9), d, 8.75)[far], expected[far], atol=1e-5, rtol=1e-6)


def test_goes_on_beyond_the_rim(path):
    # The tile spans +-0.475 m; the origin lies 5 m outside of it, and so do the hits.
    d = torch.tensor([[1.0, 0.0, -1.0], [-1.0, 0.3, -1.0], [0.0, 0.0, -1.0], [0.0, 1.0, -0.2]])
    expected = 0.5 * torch.tensor([math.sqrt(2), math.sqrt(2.09), 1.0, math.sqrt(1.04) / 0.2])
    torch.testing.assert_close(one(flat(0.2), (5.0, -6.0, 0.7), d), expected, atol=1e-5, rtol=0)


def test_slope(path):
    # z = 0.4 x - 0.3 y; from 1 m over the origin, t solves 1 + t dz = t (0.4 dx - 0.3 dy).
    x = (torch.arange(200) - 99.5) * 0.05
    field = HeightField((0.4 * x[:, None] - 0.3 * x[None, :])[None], 0.05)
    d = unit(np.random.default_rng(1), 400)
    sinking = 0.4 * d[:, 0] - 0.3 * d[:, 1] - d[:, 2]
    inside = (sinking > 0.25) & (d[:, :2].abs().amax(-1) / sinking < 4.9)
    assert inside.sum() > 100
    torch.testing.assert_close(one(field, (0.0, 0.0, 1.0), d[inside]), (1 / sinking[inside]).float(), atol=2e-5, rtol=0)
    assert one(field, (0.0, 0.0, 1.0), d[sinking < 0.05], 4.0).isinf().all()


def test_face_between_two_samples(path):
    # The ground rises from 0 to 0.5 m between x = 0 and 0.05 m.
    heights = torch.zeros(1, 41, 41)
    heights[:, 21:] = 0.5
    field = HeightField(heights, 0.05)
    for z in (0.01, 0.2, 0.499):
        expected = 0.6 + 0.05 * z / 0.5
        assert float(one(field, (-0.6, 0.013, z), [1.0, 0.0, 0.0])) == pytest.approx(expected, abs=1e-5)
    assert one(field, (-0.6, 0.013, 0.501), [1.0, 0.0, 0.0]).isinf().all()
    # From above at 45 degrees: down 0.3 m at x = -0.3 + s, met where 0.5 - s = 10 (s - 0.3).
    s = 3.5 / 11
    assert float(one(field, (-0.3, 0.0, 0.5), [1.0, 0.0, -1.0])) == pytest.approx(s * math.sqrt(2), abs=1e-5)


def test_saddle_has_the_first_of_two_roots(path):
    # Between the samples 0, 1, 1, 0 the surface is z = u + v - 2 u v, along the diagonal 2 u (1 - u).
    field = HeightField(torch.tensor([[[0.0, 1.0], [1.0, 0.0]]]), 1.0)
    root = (1 - math.sqrt(1 - 2 * 0.4)) / 2  # 2 u (1 - u) = 0.4
    assert float(one(field, (-0.5, -0.5, 0.4), [1.0, 1.0, 0.0])) == pytest.approx(root * math.sqrt(2), abs=1e-6)
    assert one(field, (-0.5, -0.5, 0.501), [1.0, 1.0, 0.0]).isinf().all()


def test_pole_of_one_sample(path):
    heights = torch.zeros(1, 101, 101)
    heights[0, 80, 50] = 1.0  # at x = 1.2, y = 0
    field = HeightField(heights, 0.04)
    # At half of its height it is half a cell wide to each side.
    y = torch.tensor([0.0, 0.0199, 0.0201, -0.0199, -0.0201])
    expected = torch.tensor([1.18, 1.2, math.inf, 1.2, math.inf])  # [m] to it from x = 0
    for k in range(5):
        got = float(one(field, (0.0, float(y[k]), 0.5), [1.0, 0.0, 0.0], 2.5))
        assert got == pytest.approx(float(expected[k]), abs=1e-3), k


def test_straight_down_and_up(path):
    rng = np.random.default_rng(4)
    field = HeightField(torch.from_numpy(rng.uniform(-0.5, 0.5, (1, 30, 30))), 0.1)
    xy = torch.from_numpy(rng.uniform(-2, 2, (50, 1, 2)))  # some outside of the tile
    tiles = torch.zeros(50, dtype=torch.int64)
    ground = field.height(tiles, xy)
    origin = torch.cat([xy[:, 0], torch.full((50, 1), 0.9)], -1)
    down, up = (torch.tensor([0.0, 0.0, s]).expand(50, 1, 3) for s in (-1.0, 1.0))
    torch.testing.assert_close(cast(field, tiles, origin, down, 5.0), 0.9 - ground, atol=1e-5, rtol=0)
    assert cast(field, tiles, origin, up, 5.0).isinf().all()


def test_starting_below_the_ground_hits_at_once(path):
    assert torch.equal(one(flat(0.3), (0.0, 0.0, 0.2), unit(np.random.default_rng(0), 9)), torch.zeros(9))


def test_range_is_the_limit(path):
    field = flat()
    assert float(one(field, (0.0, 0.0, 1.0), [0.0, 0.0, -1.0], 1.001)) == 1.0
    assert one(field, (0.0, 0.0, 1.0), [0.0, 0.0, -1.0], 0.999).isinf().all()


# The fine march -------------------------------------------------------------------------------------------------------


def clearance(field, tile, points):
    """Height (N, ...) of points (N, ..., 3) over the surface of tile (N,), NumPy float64."""
    heights = field.heights.double().numpy()
    size = np.array(heights.shape[1:])
    at = np.clip(points[..., :2] / field.resolution + (size - 1) / 2, 0, size - 1)
    cell = np.minimum(at.astype(int), size - 2)
    (u, v), (i, j) = np.moveaxis(at - cell, -1, 0), np.moveaxis(cell, -1, 0)
    k = np.broadcast_to(tile.reshape(-1, *[1] * (points.ndim - 2)), i.shape)
    near = heights[k, i, j] * (1 - v) + heights[k, i, j + 1] * v
    far = heights[k, i + 1, j] * (1 - v) + heights[k, i + 1, j + 1] * v
    return points[..., 2] - near * (1 - u) - far * u


def along(origins, directions, t):
    return origins.reshape(-1, *[1] * (t.ndim - 1), 3) + t[..., None] * directions.reshape(-1, *[1] * (t.ndim - 1), 3)


def march(field, tile, origins, directions, max_range, block=200):
    """Distances (N,) to the first sample of a fine march that lies under the ground, bisected; inf where none does."""
    distance = np.full(len(tile), np.inf)
    going = np.arange(len(tile))
    for first in np.arange(0.0, max_range, FINE * block):
        t = np.broadcast_to(first + FINE * np.arange(block + 1), (len(going), block + 1))
        under = clearance(field, tile[going], along(origins[going], directions[going], t)) <= 0
        hit = under.any(1)
        found, step = going[hit], under[hit].argmax(1)
        far = first + FINE * step
        near = np.maximum(far - FINE, 0.0)
        for _ in range(30):
            middle = (near + far) / 2
            above = clearance(field, tile[found], along(origins[found], directions[found], middle)) > 0
            near, far = np.where(above, middle, near), np.where(above, far, middle)
        distance[found] = far
        going = going[~hit]
    return np.where(distance <= max_range, distance, np.inf)


def difficult_terrain(kind, rng, resolution, shape=(44, 40), K=2):
    """Heights (K, H, W) [m]."""
    i, j = np.indices(shape)
    if kind == "flat":
        z = np.zeros((K, *shape))
    elif kind == "slope":
        z = np.stack([(a * i + b * j) * resolution for a, b in rng.uniform(-1, 1, (K, 2))])
    elif kind == "rough":
        z = rng.uniform(-0.05, 0.05, (K, *shape))
    elif kind == "stairs":
        z = np.stack([0.17 * (i // run) - 0.05 * (j // 9) for run in rng.integers(3, 9, K)])
    elif kind == "stones":
        z = np.stack([np.where((i % p < 0.6 * p) & (j % p < 0.6 * p), 0.05, -0.8) for p in rng.integers(4, 12, K)])
    elif kind == "gaps":
        z = np.stack([np.where((i + j) % p < 3, -1.0, 0.0) for p in rng.integers(7, 14, K)])
    elif kind == "poles":
        z = np.where(rng.uniform(size=(K, *shape)) < 0.02, rng.uniform(0.1, 0.8, (K, *shape)), 0.0)
    return HeightField(torch.from_numpy(z), resolution)


def difficult_rays(kind, rng, field, N):
    """Tiles (N,), origins (N, 3) and directions (N, 3), NumPy."""
    tile = rng.integers(field.num_tiles, size=N)
    half = np.array(field.heights.shape[1:]) * field.resolution / 2
    xy = rng.uniform(-1, 1, (N, 2)) * half * (1.8 if kind == "outside" else 0.95)
    ground = -clearance(field, tile, np.column_stack([xy, np.zeros(N)]))
    low = kind in ("grazing", "horizontal")
    origins = np.column_stack([xy, ground + rng.uniform(0.001, 0.05 if low else 0.8, N)]).astype(np.float32)
    d = rng.normal(size=(N, 3))
    if kind == "grazing":
        d[:, 2] *= 0.05
    elif kind == "horizontal":
        d[:, 2] = 0.0
    elif kind == "down":
        d[:, :2] *= rng.uniform(0, 0.3, (N, 1)) ** 3
        d[:, 2] = -1.0
    elif kind == "up":
        d[:, 2] = 0.3 * abs(d[:, 2])
    elif kind == "along the cells":
        d[np.arange(N), rng.integers(2, size=N)] = 0.0
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return tile, origins, d


TERRAINS = ["flat", "slope", "rough", "stairs", "stones", "gaps", "poles"]
RAYS = ["any", "grazing", "horizontal", "down", "up", "along the cells", "outside"]


@pytest.mark.parametrize("terrain", TERRAINS)
def test_equals_a_fine_march(terrain):
    """All kinds of rays on one kind of terrain: 3,150 of them, and 22,050 over all terrains."""
    rng, N, reach, touching = np.random.default_rng(TERRAINS.index(terrain)), 150, 1.5, 0
    for resolution in (0.02, 0.035, 0.05):
        field = difficult_terrain(terrain, rng, resolution)
        for kind in RAYS:
            tile, origins, d = difficult_rays(kind, rng, field, N)
            expected = march(field, tile, origins.astype(float), d.astype(float), reach)
            got = cast(field, torch.from_numpy(tile), torch.from_numpy(origins), torch.from_numpy(d)[:, None], reach)
            got = got[:, 0].double().numpy()
            far = (np.minimum(got, expected) > reach - FINE) | (got == expected)
            differ = np.flatnonzero(~far & ~np.isclose(got, expected, rtol=0, atol=0.005))
            touching += len(differ)
            assert all(only_touches(field, tile[n], origins[n], d[n], got[n], expected[n]) for n in differ), kind
    assert touching <= 10  # of 3,150


def only_touches(field, tile, origin, d, got, expected):
    """Tell whether the hit in question is one of a ray that comes within 10 um of the ground, or less than FINE in."""
    t = np.linspace(-0.02, 0.02, 8001) + min(got, expected)
    over = clearance(field, np.array([tile]), along(origin[None].astype(float), d[None].astype(float), t[None]))[0]
    if got < expected:  # the march sees nothing that is shorter than a step
        return abs(over[4000]) < 1e-5 and (over < 0).sum() * 5e-6 <= 2 * FINE
    return over.min() > -1e-5


def test_ray_that_is_next_to_a_border_by_rounding():
    # -1e-9 lies before border 0, but its distance from border -1 rounds to 1: that cell must be searched all the same.
    field, start = flat(0.0, resolution=1.0), torch.tensor([[-1e-9], [5.5], [0.1]])
    step, none = torch.tensor([[-1.0], [0.0], [-1.0]]), torch.zeros(1, dtype=torch.int64)
    inverse = torch.tensor([[1.0], [1e9]])
    rays = tracing.Rays(none, none, torch.zeros(1), start, step, torch.tensor([[-1.0], [1.0]]), inverse)
    for count in (1, 2, 5):
        ahead, horizon = tracing.search(field, rays, count)
        assert float(ahead) == pytest.approx(0.1) and float(horizon) == count + 1


def test_air_above_everything_takes_one_round(monkeypatch):
    field, tiles, origin, _ = scene(3)
    counts, search = [], tracing.search
    monkeypatch.setattr(tracing, "search", lambda *args: (counts.append(1), search(*args))[1])
    d = torch.tensor([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.6, 0.8]]).expand(3, 3, 3)
    assert cast(field, tiles, origin + torch.tensor([0.0, 0.0, 5.0]), d, 100.0).isinf().all()
    assert len(counts) == 1


def test_march_finds_what_it_must():
    """The reference itself, where the answer is known."""
    heights = torch.zeros(1, 41, 41)
    heights[:, 21:] = 0.5
    field, d = HeightField(heights, 0.05), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    origins = np.tile([-0.6, 0.013, 0.2], (3, 1))
    np.testing.assert_allclose(march(field, np.zeros(3, int), origins, d, 1.5), [0.62, 0.2, np.inf], atol=1e-9)


@pytest.mark.parametrize("terrain", TERRAINS)
def test_no_ray_is_left_over(terrain, path, monkeypatch):
    """After the last round each ray has met the ground or come to the end of its range, also the longest ones."""
    rng, last, seen = np.random.default_rng(9), {}, {}
    search = tracing.search

    def watched(field, rays, count):
        ahead, horizon = search(field, rays, count)
        seen["max"] = max(seen.get("max", 0), count)
        done = (ahead <= horizon) | (rays.along + horizon > 6.0)
        last.update({n: last.get(n, False) or d for n, d in zip(rays.ray.tolist(), done.tolist(), strict=True)})
        return ahead, horizon

    monkeypatch.setattr(tracing, "search", watched)
    field = difficult_terrain(terrain, rng, 0.03)
    for kind in RAYS:
        last.clear()
        tile, origins, d = difficult_rays(kind, rng, field, 60)
        cast(field, torch.from_numpy(tile), torch.from_numpy(origins), torch.from_numpy(d)[:, None], 6.0)
        assert len(last) == 60 and all(last.values()), kind
    assert seen["max"] == tracing.MAX_CELLS


# Properties -----------------------------------------------------------------------------------------------------------


def scene(seed, B=3, M=40, kind="any", resolution=0.04):
    """A field of mixed terrain and rays from one origin per environment."""
    rng = np.random.default_rng(seed)
    field = difficult_terrain(TERRAINS[seed % len(TERRAINS)], rng, resolution, K=B)
    tile, origins, _ = difficult_rays(kind, rng, field, B)
    return field, torch.from_numpy(tile), torch.from_numpy(origins), unit(rng, B, M).float()


def same(one, other, atol=5e-5):
    torch.testing.assert_close(one, other, atol=atol, rtol=0)


@given(st.integers(0, 10_000))
def test_hits_lie_on_the_surface(seed):
    field, tiles, origin, d = scene(seed)
    t = cast(field, tiles, origin, d, 3.0)
    points = origin[:, None] + t.nan_to_num(posinf=0.0)[..., None] * d
    over = points[..., 2] - field.height(tiles, points[..., :2])
    assert (over[t.isfinite()].abs() < 2e-4).all()  # the steepest face rises 0.8 m in 0.04 m


@given(st.integers(0, 10_000))
def test_paths_agree(seed):
    field, tiles, origin, d = scene(seed, kind=RAYS[seed % len(RAYS)])
    picked = cast(field, tiles, origin, d, 4.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracing, "can_select_rays", lambda device: False)
        same(cast(field, tiles, origin, d, 4.0), picked)


@given(st.integers(0, 10_000))
def test_batch_equals_single(seed):
    field, tiles, origin, d = scene(seed, B=4)
    together = cast(field, tiles, origin, d, 4.0)
    for b in range(4):
        same(cast(field, tiles[b : b + 1], origin[b : b + 1], d[b : b + 1], 4.0), together[b : b + 1])
        alone = HeightField(field.heights[tiles[b]][None], field.resolution)
        same(cast(alone, torch.tensor([0]), origin[b : b + 1], d[b : b + 1], 4.0), together[b : b + 1])


@given(st.integers(0, 10_000))
def test_order_of_rays_and_environments_is_irrelevant(seed):
    field, tiles, origin, d = scene(seed, B=4)
    generator = torch.Generator().manual_seed(seed)
    rays, envs = torch.randperm(d.shape[1], generator=generator), torch.randperm(4, generator=generator)
    expected = cast(field, tiles, origin, d, 4.0)
    assert torch.equal(cast(field, tiles, origin, d[:, rays], 4.0), expected[:, rays])
    assert torch.equal(cast(field, tiles[envs], origin[envs], d[envs], 4.0), expected[envs])


@given(st.integers(0, 10_000), st.integers(-9, 9), st.integers(-9, 9))
def test_moves_with_the_terrain(seed, i, j):
    rng = np.random.default_rng(seed)
    patch, resolution = rng.uniform(-0.2, 0.2, (12, 12)), 0.0625  # moves are exact in float32
    heights = np.zeros((2, 40, 40))
    heights[0, 14:26, 14:26] = patch
    heights[1, 14 + i : 26 + i, 14 + j : 26 + j] = patch
    field, d = HeightField(torch.from_numpy(heights), resolution), unit(rng, 1, 60).float().expand(2, -1, -1)
    origin = torch.tensor([[0.1, -0.2, 0.4]]) + torch.tensor([[0.0, 0.0, 0.0], [i * resolution, j * resolution, 0.0]])
    t = cast(field, torch.tensor([0, 1]), origin, d, 5.0)
    same(t[0], t[1])


def test_far_more_rays_than_a_round_searches_at_once():
    field, tiles, origin, d = scene(6, B=2, M=20_000)
    t = cast(field, tiles, origin, d, 3.0)
    part = cast(field, tiles, origin, d[:, ::97], 3.0)
    same(t[:, ::97], part)


def test_parts_make_the_whole(monkeypatch):
    field, tiles, origin, d = scene(2, B=5)
    boxes = Boxes(torch.eye(4).expand(5, 1, 4, 4) + 0, torch.rand(5, 1, 3))
    whole = cast(field, tiles, origin, d, 3.0, boxes)
    monkeypatch.setattr("torchelev.sim.sensors.casting.MAX_RAYS", 2 * d.shape[1] + 1)
    same(cast(field, tiles, origin, d, 3.0, boxes), whole)
    monkeypatch.setattr("torchelev.sim.sensors.casting.MAX_RAYS", 1)
    same(cast(field, tiles, origin, d, 3.0, boxes), whole)


# Boxes ----------------------------------------------------------------------------------------------------------------


def box(position, half_size, yaw=0.0, pitch=0.0, roll=0.0):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(rotation(yaw, pitch, roll))
    T[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return Boxes(T[None, None], torch.tensor([[half_size]], dtype=torch.float64))


def test_faces_of_a_box():
    cube, o = box((2.0, 0.0, 1.0), (0.5, 0.25, 0.1)), (0.0, 0.0, 1.0)
    rays = [[1.0, 0, 0], [-1.0, 0, 0], [2.0, 0.24, 0], [1.5, 0.26, 0], [0, 0, 1.0]]
    expected = torch.tensor([1.5, math.inf, 1.5 * math.hypot(1, 0.12), math.inf, math.inf])
    torch.testing.assert_close(one(flat(), o, rays, 5.0, cube), expected, atol=1e-5, rtol=0)
    assert float(one(flat(), (2.0, 0.1, 3.0), [0, 0, -1.0], 5.0, cube)) == pytest.approx(1.9, abs=1e-5)
    for y, expected in ((0.24, 1.5), (0.26, math.inf), (-0.26, math.inf)):  # along two pairs of faces
        assert float(one(flat(), (0.0, y, 1.05), [1.0, 0, 0], 5.0, cube)) == pytest.approx(expected, abs=1e-5)
    # Turned by 45 degrees about z its edge points here: at 2 - 0.25 sqrt(2) of a square of 0.25.
    square = box((2.0, 0.0, 1.0), (0.25, 0.25, 0.1), yaw=math.pi / 4)
    expected = 2 - 0.25 * math.sqrt(2)
    assert float(one(flat(), o, [1.0, 0, 0], 5.0, square)) == pytest.approx(expected, abs=1e-5)


def test_nearer_of_box_and_ground_is_hit():
    field, low = flat(), box((1.0, 0.0, 0.1), (0.2, 0.2, 0.1))
    d = [[1.0, 0.0, -1.0], [1.0, 0.0, -0.5], [0.7, 0.0, -1.0]]  # over the box 1 m away, at 0.8..1.2 m and 0..0.2 m
    expected = torch.tensor([0.8 * math.sqrt(2), math.hypot(2.0, 1.0), math.hypot(0.7, 1.0)])
    torch.testing.assert_close(one(field, (0.0, 0.0, 1.0), d, 5.0, low), expected, atol=1e-5, rtol=0)


def test_inside_a_box_everything_is_hit_at_once():
    d, around = unit(np.random.default_rng(0), 20), box((1.1, 1.0, 1.0), (0.5, 0.5, 0.5), yaw=1.0)
    assert torch.equal(one(flat(), (1.0, 1.0, 1.0), d, 5.0, around), torch.zeros(20))


@pytest.mark.parametrize("half_size", [(0.0, 0.5, 0.5), (0.0, 0.0, 0.0), (-1.0, -1.0, -1.0), (0.5, 0.5, math.nan)])
def test_absent_boxes_are_not_there(half_size):
    d = unit(np.random.default_rng(1), 50)
    absent = box((0.5, 0.0, 1.0), half_size)
    assert torch.equal(one(flat(), (0.5, 0.0, 1.0), d, 5.0, absent), one(flat(), (0.5, 0.0, 1.0), d, 5.0))


def test_absent_boxes_may_lack_a_pose():
    d = unit(np.random.default_rng(1), 50)
    absent, there = box((math.nan, 0.0, 1.0), (0.0, 0.0, 0.0)), box((0.5, 0.0, 1.0), (0.1, 0.1, 0.1))
    both = there.joined(absent)
    assert torch.equal(one(flat(), (0.0, 0.0, 1.0), d, 5.0, both), one(flat(), (0.0, 0.0, 1.0), d, 5.0, there))


def slab(T, half, origin, d):
    """Distance to one box by its definition: the first of the entries into its faces' planes that lies on the box."""
    o, d = T[:3, :3].T @ (origin - T[:3, 3]), T[:3, :3].T @ d
    if (abs(o) <= half).all():
        return 0.0
    best = np.inf
    for axis in range(3):
        for side in (-1, 1):
            t = (side * half[axis] - o[axis]) / d[axis]
            at = np.delete(abs(o + t * d) - half, axis)
            if t > 0 and (at <= 1e-9).all():
                best = min(best, t)
    return best


@given(st.integers(0, 10_000))
def test_boxes_by_definition(seed):
    rng, B, K, M = np.random.default_rng(seed), 2, 4, 25
    T = np.tile(np.eye(4), (B, K, 1, 1))
    for b, k in np.ndindex(B, K):
        T[b, k, :3, :3], T[b, k, :3, 3] = rotation(*rng.uniform(-3, 3, 3)), rng.uniform(-1, 1, 3) + (0, 0, 3)
    half, origin = rng.uniform(0.05, 0.6, (B, K, 3)), rng.uniform(-2, 2, (B, 3)) + (0, 0, 3)
    aim = T[..., :3, 3][:, rng.integers(K, size=M)] + rng.normal(0, 0.3, (B, M, 3)) - origin[:, None]
    d = aim / np.linalg.norm(aim, axis=-1, keepdims=True)
    boxes = Boxes(torch.from_numpy(T), torch.from_numpy(half))
    tiles = torch.zeros(B, dtype=torch.int64)
    got = cast(flat(-50.0), tiles, torch.from_numpy(origin), torch.from_numpy(d), 20.0, boxes)
    for b, m in np.ndindex(B, M):
        expected = min(slab(T[b, k], half[b, k], origin[b], d[b, m]) for k in range(K))
        clear = all(abs(grown - expected) < 1e-3 or grown == expected for grown in (
            min(slab(T[b, k], half[b, k] + s * 1e-5, origin[b], d[b, m]) for k in range(K)) for s in (-1, 1)
        ))  # fmt: skip
        assert not clear or float(got[b, m]) == pytest.approx(expected, abs=1e-4)


def test_boxes_are_moved_and_joined():
    base = box((1.0, 2.0, 3.0), (1.0, 1.0, 1.0), yaw=0.5)
    leg = box((0.5, 0.0, -0.25), (0.1, 0.1, 0.2), pitch=0.25)
    moved = leg.moved(base.T_map_box[:, 0])
    torch.testing.assert_close(moved.T_map_box[0, 0], base.T_map_box[0, 0] @ leg.T_map_box[0, 0])
    joined = base.joined(moved)
    assert joined.T_map_box.shape == (1, 2, 4, 4) and joined.half_size[0, 1].tolist() == [0.1, 0.1, 0.2]


# Devices, and what is refused -----------------------------------------------------------------------------------------


def on(device, B=2, M=5, K=3):
    """A field, and what `cast` takes with it."""
    field = HeightField(torch.rand(2, 20, 30), 0.05).to(device)
    boxes = Boxes(torch.eye(4).expand(B, K, 4, 4).to(device), torch.full((B, K, 3), 0.1).to(device))
    directions = torch.nn.functional.normalize(torch.rand(B, M, 3) - 0.5, dim=-1).to(device)
    return field, torch.zeros(B, dtype=torch.int64).to(device), torch.rand(B, 3).to(device), directions, 8.0, boxes


def test_host_reads_nothing_back(monkeypatch):
    inputs = on("meta")
    for constructor in ("tensor", "as_tensor", "from_numpy"):
        monkeypatch.setattr(torch, constructor, None)
    with OneDevice():
        assert cast(*inputs).shape == (2, 5)


def test_path_of_a_gpu_has_static_shapes(monkeypatch):
    monkeypatch.setattr(tracing, "can_select_rays", lambda device: False)
    field, *inputs, reach, boxes = on("cpu")
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        boxes = Boxes(*(mode.from_tensor(v) for v in boxes))
        assert cast(field, *(mode.from_tensor(v) for v in inputs), reach, boxes).shape == (2, 5)


@needs_gpu
def test_gpu_equals_cpu():
    torch.manual_seed(0)
    field, *inputs = on("cpu", B=2, M=400)
    expected = cast(field, *inputs)
    moved = [v.cuda() if isinstance(v, torch.Tensor) else v for v in inputs[:-1]]
    boxes, field = Boxes(*(v.cuda() for v in inputs[-1])), field.to("cuda")
    cast(field, *moved, boxes)
    torch.cuda.set_sync_debug_mode("error")
    try:
        got = cast(field, *moved, boxes)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    same(got.cpu(), expected, 1e-4)


def test_origin_that_is_not_finite_hits_nothing(path):
    field, tiles, origin, d, reach, _ = on("cpu")
    clean = cast(field, tiles, origin, d, reach)
    origin[0, 1] = math.nan
    t = cast(field, tiles, origin, d, reach)
    assert t[0].isinf().all()
    same(t[1], clean[1])


def test_takes_inputs_of_any_precision_and_leaves_them_alone():
    field, tiles, origin, d, reach, boxes = on("cpu")
    before = [origin.clone(), d.clone(), boxes.T_map_box.clone(), boxes.half_size.clone(), field.padded.clone()]
    doubled = Boxes(boxes.T_map_box.double(), boxes.half_size.double())
    t = cast(field, tiles, origin.double(), d.double(), reach, doubled)
    assert t.dtype == torch.float32 and torch.equal(t, cast(field, tiles, origin, d, reach, boxes))
    after = [origin, d, boxes.T_map_box, boxes.half_size, field.padded]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_no_rays_no_environments_no_boxes():
    field, tiles, origin, d, reach, boxes = on("cpu")
    assert cast(field, tiles, origin, d[:, :0], reach).shape == (2, 0)
    assert cast(field, tiles[:0], origin[:0], d[:0], reach).shape == (0, 5)
    none = Boxes(boxes.T_map_box[:, :0], boxes.half_size[:, :0])
    assert torch.equal(cast(field, tiles, origin, d, reach, none), cast(field, tiles, origin, d, reach))


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(origin=torch.zeros(3, 3)), "origin, directions"),
        (dict(directions=torch.zeros(2, 3)), "origin, directions"),
        (dict(directions=torch.zeros(1, 5, 3)), "origin, directions"),
        (dict(max_range=0.0), "max_range"),
        (dict(max_range=math.inf), "max_range"),
        (dict(tile_ids=torch.tensor([0, 2])), "tile_ids"),
        (dict(tile_ids=torch.tensor([-1, 0])), "tile_ids"),
        (dict(tile_ids=torch.tensor([0, 1], dtype=torch.int32)), "tile_ids: must be int64"),
        (dict(origin=torch.zeros(2, 3, device="meta")), "must be on cpu"),
        (dict(boxes=Boxes(torch.eye(4).expand(1, 3, 4, 4), torch.ones(1, 3, 3))), "boxes"),
        (dict(boxes=Boxes(torch.eye(4).expand(2, 4, 4), torch.ones(2, 3))), "boxes"),
    ],
)
def test_refuses(change, text):
    error = TypeError if "must be int64" in text else ValueError
    names = ("field", "tile_ids", "origin", "directions", "max_range", "boxes")
    with pytest.raises(error, match=text):
        cast(**{**dict(zip(names, on("cpu"), strict=True)), **change})
