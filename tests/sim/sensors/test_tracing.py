"""Rays at height fields against closed forms and against a fine march."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import never_wait
from tests.sim.sensors.ray_cases import (
    FINE,
    RAYS,
    SURFACES,
    TERRAINS,
    along,
    clearance,
    difficult_rays,
    difficult_terrain,
    flat,
    march,
    one,
    same,
    scene,
    unit,
)
from torchelev.sim.sensors import tracing
from torchelev.sim.sensors.casting import cast
from torchelev.sim.terrains.heightfield import HeightField


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


@pytest.mark.slow(13)
@pytest.mark.parametrize("terrain", TERRAINS)
def test_equals_a_fine_march(terrain):
    """All kinds of rays on one kind of terrain: 2,625 of them, and 18,375 over all terrains, by C++ and by tensors."""
    rng, N, reach, touching = np.random.default_rng(TERRAINS.index(terrain)), 75, 1.5, 0
    for resolution, surface in zip((0.02, 0.035, 0.05, 0.035, 0.05), (0, 0, 0, 1, 2), strict=True):
        field = difficult_terrain(terrain, rng, resolution).with_surface(*SURFACES[surface])
        for kind in RAYS:
            tile, origins, d = difficult_rays(kind, rng, field, N)
            expected = march(field, tile, origins.astype(float), d.astype(float), reach)
            rays = torch.from_numpy(tile), torch.from_numpy(origins), torch.from_numpy(d)[:, None], reach
            for got in (cast(field, *rays)[:, 0].numpy(), by_tensors(field, *rays)[:, 0].numpy()):
                far = (np.minimum(got, expected) > reach - FINE) | (got == expected)
                differ = np.flatnonzero(~far & ~np.isclose(got, expected, rtol=0, atol=0.005))
                touching += len(differ)
                assert all(only_touches(field, tile[n], origins[n], d[n], got[n], expected[n]) for n in differ), kind
    assert touching <= 16  # of 5,250


def only_touches(field, tile, origin, d, got, expected):
    """Return whether the hit in question is of a ray that comes within 10 um of the ground, or less than FINE in."""
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


@pytest.fixture
def searches(monkeypatch):
    """The rounds in which rays are searched: the rays, the number of cells, and what is found ahead up to where."""
    rounds, search = [], tracing.search

    def noted(field, rays, count):
        found = search(field, rays, count)
        rounds.append((rays, count, *found))
        return found

    monkeypatch.setattr(tracing, "search", noted)
    return rounds


def test_air_above_everything_takes_one_round(searches, monkeypatch):
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    field, tiles, origin, _ = scene(3)
    d = torch.tensor([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.6, 0.8]]).expand(3, 3, 3)
    assert cast(field, tiles, origin + torch.tensor([0.0, 0.0, 5.0]), d, 100.0).isinf().all()
    assert len(searches) == 1


def test_march_finds_what_it_must():
    """The reference itself, where the answer is known."""
    heights = torch.zeros(1, 41, 41)
    heights[:, 21:] = 0.5
    field, d = HeightField(heights, 0.05), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    origins = np.tile([-0.6, 0.013, 0.2], (3, 1))
    np.testing.assert_allclose(march(field, np.zeros(3, int), origins, d, 1.5), [0.62, 0.2, np.inf], atol=1e-9)


@pytest.mark.slow(1)
@pytest.mark.parametrize("terrain", TERRAINS)
@pytest.mark.parametrize("path", ["selects rays", "keeps all rays"], indirect=True)
def test_no_ray_is_left_over(terrain, path, searches):
    """After the last round each ray has met the ground or come to the end of its range, also the longest ones."""
    rng, most = np.random.default_rng(9), 0
    field = difficult_terrain(terrain, rng, 0.03)
    for kind in RAYS:
        searches.clear()
        tile, origins, d = difficult_rays(kind, rng, field, 60)
        cast(field, torch.from_numpy(tile), torch.from_numpy(origins), torch.from_numpy(d)[:, None], 6.0)
        done = torch.zeros(60, dtype=torch.bool)
        for rays, count, ahead, horizon in searches:
            done[rays.ray] |= (ahead <= horizon) | (rays.along + horizon > 6.0)
            most = max(most, count)
        assert done.all(), kind
    assert most == tracing.MAX_CELLS


@pytest.mark.slow(1)
@given(st.integers(0, 10_000))
def test_hits_lie_on_the_surface(seed):
    field, tiles, origin, d = scene(seed)
    t = cast(field, tiles, origin, d, 3.0)
    points = origin[:, None] + t.nan_to_num(posinf=0.0)[..., None] * d
    over = points[..., 2] - field.height(tiles, points[..., :2])
    assert (over[t.isfinite()].abs() < 2e-4).all()  # the steepest face rises 0.8 m in 0.04 m


def by_tensors(*arguments, selects=True):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHELEV_NATIVE", "0")
        if not selects:
            never_wait(patch)
        return cast(*arguments)


@given(st.integers(0, 10_000), st.integers(1, 2))
def test_paths_agree(seed, threads):
    field, tiles, origin, d = scene(seed, kind=RAYS[seed % len(RAYS)])
    picked = by_tensors(field, tiles, origin, d, 4.0)
    same(by_tensors(field, tiles, origin, d, 4.0, selects=False), picked)
    torch.set_num_threads(threads)
    same(cast(field, tiles, origin, d, 4.0), picked)


@pytest.mark.slow(1)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30, 0.0])
def test_directions_that_are_none_end_all_the_same(bad, path):
    field, tiles, origin, d = scene(4, B=3)
    expected = cast(field, tiles, origin, d, 4.0)
    for k in range(3):
        broken = d.clone()
        broken[:, ::7, k] = bad
        t = cast(field, tiles, origin, broken, 4.0)
        assert not t.isnan().any() and (t >= 0).all()
        others = torch.arange(d.shape[1]) % 7 > 0
        same(t[:, others], expected[:, others])


@given(st.integers(0, 10_000))
def test_batch_equals_single(seed):
    field, tiles, origin, d = scene(seed, B=4)
    together = cast(field, tiles, origin, d, 4.0)
    for b in range(4):
        same(cast(field, tiles[b : b + 1], origin[b : b + 1], d[b : b + 1], 4.0), together[b : b + 1])
        alone = HeightField(field.heights[tiles[b]][None], field.resolution)
        alone.surface = field.surface
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
    same(t[:, ::97], by_tensors(field, tiles, origin, d[:, ::97], 3.0))
