"""Terrains: their truth by hand, their fields equal to it at the samples, harder with difficulty, flat at the start."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.devices import NoConstants, OneDevice
from torchelev.sim.terrains import shapes as terrain_shapes
from torchelev.sim.terrains.generate import make_terrain, terrain_grid
from torchelev.sim.terrains.shapes import SHAPES

KINDS = list(SHAPES)
# Highest and lowest ground on a tile of 8 m at difficulties 0 and 1 [m]; slopes rise or fall.
RANGE = {
    "flat": ((0.0, 0.0), (0.0, 0.0)),
    "slope": ((0.0, 0.0), (-1.198, 1.198)),
    "stairs_up": ((-0.45, 0.0), (-2.07, 0.0)),
    "stairs_down": ((0.0, 0.45), (0.0, 2.07)),
    "boxes": ((-0.05, 0.05), (-0.2, 0.2)),
    "stepping_stones": ((-1.0, 0.0), (-1.0, 0.05)),
    "gaps": ((-1.0, 0.0), (-1.0, 0.0)),
    "rough": ((-0.01, 0.01), (-0.05, 0.05)),
    "rails": ((0.0, 0.05), (0.0, 0.25)),
}
PLATFORM = {"stairs_up": 1.505, "stairs_down": 1.505, "gaps": 1.505, "rails": 1.505, "flat": 4.0, "rough": 1.0}


def terrain(kind, *difficulty, **options):
    """Tiles of one kind, coarse unless said otherwise."""
    return make_terrain(kind, torch.tensor(difficulty), **{"resolution": 0.1} | options)


def heights_at(t, *xy, tile=0):
    """Truth at places of one tile."""
    return t.truth(torch.tensor([tile]), torch.tensor([xy]))[0]


def samples(t):
    """Places (1, H * W, 2) of a field's samples."""
    n = t.field.heights.shape[1]
    along = ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * t.field.resolution).float()
    return torch.stack(torch.meshgrid(along, along, indexing="ij"), -1).view(1, -1, 2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("resolution", [0.04, 0.1])
def test_the_field_is_the_truth_at_its_samples(kind, resolution):
    t = terrain(kind, 0.0, 0.37, 1.0, resolution=resolution)
    xy = samples(t)
    n = round(8.0 / resolution) + 1
    assert t.field.heights.shape == (3, n, n) and t.field.heights.dtype == torch.float32
    ids = torch.tensor([2, 0, 1])
    truth = t.truth(ids, xy.expand(3, -1, 2))
    torch.testing.assert_close(truth.view(3, n, n), t.field.heights[ids], atol=0, rtol=0)
    # The bilinear surface too, but for the rounding of a place to its cell, on cliffs of 1 m between two samples.
    torch.testing.assert_close(t.field.height(ids, xy.expand(3, -1, 2)), truth, atol=1e-4, rtol=0)


@pytest.mark.slow(1)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("hard", [0, 1])
def test_heights_lie_within_what_the_table_says_and_use_it(kind, hard):
    t = terrain(kind, *[float(hard)] * 8, resolution=0.04)
    low, high = RANGE[kind][hard]
    z = t.field.heights
    assert low - 1e-3 <= float(z.min()) and float(z.max()) <= high + 1e-3
    reached = (float(z.max()) - float(z.min())) / max(high - low, 1e-9)
    assert reached > 0.9 or high == low


@pytest.mark.parametrize("kind", KINDS)
def test_the_start_is_flat_at_zero(kind):
    t = terrain(kind, 0.0, 0.5, 1.0)
    half = PLATFORM.get(kind, 1.005) - 1e-3
    xy = (torch.rand(3, 3000, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1) * half
    assert torch.equal(t.truth(torch.arange(3), xy), torch.zeros(3, 3000))
    outside = torch.tensor([[[half + 0.04, 0.0]]]).expand(3, 1, 2)
    if kind in ("stairs_up", "stairs_down", "gaps", "rails"):
        assert bool((t.truth(torch.arange(3), outside) != 0).all())


@pytest.mark.parametrize("kind", KINDS[1:])
def test_harder_is_higher_wider_or_steeper(kind):
    t = terrain(kind, 0.0, 0.25, 0.5, 0.75, 1.0, resolution=0.04)
    t.random[:] = t.random[:1]  # the same chance for all: difficulty alone differs
    xy = samples(t).expand(5, -1, 2)
    z = t.truth(torch.arange(5), xy)
    hardness = {
        "gaps": (z < 0).float().mean(-1),
        "stepping_stones": (z <= -1).float().mean(-1),
    }.get(kind, z.abs().amax(-1))
    assert bool((hardness.diff() > 0).all()), hardness


def test_stairs_by_hand():
    # Steps of 0.05 + 0.18 d: 0.14 m at difficulty 0.5; edges at 1.505, 1.805, 2.105 m and so on.
    t = terrain("stairs_up", 0.5)
    places = [(1.5, 0.0), (1.51, 0.0), (-1.80, 0.3), (-1.81, 0.3), (0.0, 2.0), (1.9, -2.2), (4.0, 4.0)]
    expected = [0.0, -0.14, -0.14, -0.28, -0.28, -0.42, -9 * 0.14]
    torch.testing.assert_close(heights_at(t, *places), torch.tensor(expected))
    torch.testing.assert_close(heights_at(terrain("stairs_down", 0.5), *places), -torch.tensor(expected))


def test_slopes_by_hand():
    t = terrain("slope", *[1.0] * 40)
    z = t.truth(torch.arange(40), torch.tensor([[[2.005, 0.0], [0.0, -3.005], [1.5, 2.005]]]).expand(40, 3, 2))
    sign = z[:, :1].sign()
    torch.testing.assert_close(z * sign, torch.tensor([[0.4, 0.8, 0.4]]).expand(40, 3), atol=1e-6, rtol=0)
    assert 5 < int((sign > 0).sum()) < 35  # both pyramids and bowls: 5 standard errors of 40 fair coins are 16


def test_gaps_and_rails_by_hand():
    # Gaps of 0.1 + 0.7 d = 0.45 m, then 1 m of ground: 1.505 to 1.955, 2.955 to 3.405.
    z = heights_at(terrain("gaps", 0.5), (1.5, 0), (1.51, 0), (0, 1.95), (0, 1.96), (2.95, 1), (-2.96, 1), (3.41, 0))
    assert z.tolist() == [0.0, -1.0, -1.0, 0.0, 0.0, -1.0, 0.0]
    # Rails of 0.05 + 0.2 d = 0.15 m: 1.505 to 1.565, 2.305 to 2.365.
    z = heights_at(terrain("rails", 0.5), (1.5, 0), (1.51, 0), (0, 1.56), (0, 1.57), (2.30, 1), (-2.31, 1), (2.37, 0))
    torch.testing.assert_close(z, torch.tensor([0.0, 0.15, 0.15, 0.0, 0.0, 0.15, 0.0]))


def test_every_rail_is_met_by_a_sample_of_the_default_field():
    z = make_terrain("rails", torch.tensor([1.0])).field.heights[0]
    walk = z[100:, 100]  # from the middle along +x
    assert int((walk.diff() > 0).sum()) == 4  # at 1.505, 2.305, 3.105 and 3.905 m


def test_boxes_are_level_within_their_squares():
    t = terrain("boxes", 1.0)
    first = torch.tensor([0.013 + 0.45 * i for i in range(-8, 8)])
    u = torch.linspace(0.002, 0.448, 7)
    for x0 in first[first > 1.01].tolist():
        xy = torch.stack(torch.meshgrid(x0 + u, first[4] + u, indexing="ij"), -1).view(1, -1, 2)
        z = t.truth(torch.tensor([0]), xy)
        assert float(z.max() - z.min()) == 0.0
    centres = torch.stack(torch.meshgrid(first + 0.2, first + 0.2, indexing="ij"), -1).view(1, -1, 2)
    outside = centres.abs().amax(-1)[0] > 1.01
    assert len(t.truth(torch.tensor([0]), centres)[0, outside].unique()) == int(outside.sum())  # each its own


def test_stones_have_their_width_and_stay_apart():
    t = terrain("stepping_stones", 1.0, resolution=0.01, length=8.0)
    z = t.field.heights[0]
    on_stone = (z > -1).numpy()
    runs = []
    for row in np.concatenate([on_stone, on_stone.T]):
        edges = np.flatnonzero(np.diff(np.r_[False, row, False].astype(int)))
        runs += [(b - a, a, b) for a, b in edges.reshape(-1, 2) if a > 0 and b < len(row)]
    widths = np.array([w for w, a, b in runs if b < 290 or a > 510])  # clear of the platform
    assert widths.max() <= 26 and widths.min() >= 24  # 0.25 m of samples of 1 cm
    holes = [
        np.diff(np.flatnonzero(np.diff(row.astype(int)))).min() for row in on_stone if row[:290].any() and not row[0]
    ]
    assert min(holes) >= 14  # 0.3 m apart, moved by a quarter of that each: 0.15 m


def test_rough_ground_is_bilinear_between_its_lattice():
    t = terrain("rough", 1.0)
    a, b, c, d = heights_at(t, (2.0, 1.4), (2.2, 1.4), (2.0, 1.6), (2.2, 1.6)).tolist()
    assert len({a, b, c, d}) == 4 and max(abs(v) for v in (a, b, c, d)) <= 0.05
    z = heights_at(t, (2.05, 1.4), (2.05, 1.55), (2.1, 1.5))
    first, last = a + 0.25 * (b - a), c + 0.25 * (d - c)
    expected = torch.tensor([first, first + 0.75 * (last - first), (a + b + c + d) / 4])
    torch.testing.assert_close(z, expected, atol=1e-6, rtol=0)


def test_beyond_the_rim_the_rims_height_goes_on():
    t = terrain("stairs_down", 0.5)
    for x in (4.0, 4.3, 100.0):
        torch.testing.assert_close(heights_at(t, (x, 0.0)), torch.tensor([9 * 0.14]))
        field = t.field.height(torch.tensor([0]), torch.tensor([[[x, 0.0]]]))[0]
        torch.testing.assert_close(field, heights_at(t, (x, 0.0)))


def test_chance_differs_between_tiles_and_repeats_from_a_seed():
    for kind in ("boxes", "stepping_stones", "rough"):
        t = terrain(kind, 1.0, 1.0)
        assert not torch.equal(t.field.heights[0], t.field.heights[1])
        assert torch.equal(terrain(kind, 1.0, 1.0).field.heights, t.field.heights)
        assert not torch.equal(terrain(kind, 1.0, 1.0, seed=1).field.heights, t.field.heights)


# The grid -----------------------------------------------------------------------------------------------------------


def test_a_grid_has_each_kind_at_each_level():
    grid = terrain_grid(["stairs_up", "boxes", "gaps"], 5, resolution=0.1)
    assert grid.field.num_tiles == 15 and len(grid.kind) == 15
    for level in range(5):
        for number, name in enumerate(grid.kinds):
            tile = int(grid.tile_ids(torch.tensor([level]), torch.tensor([number])))
            assert grid.kind[tile] == name
            assert float(grid.difficulty[tile]) == pytest.approx(level / 4)
            alone = make_terrain(name, torch.tensor([level / 4]), resolution=0.1)
            alone.random[:] = grid.random[tile]
            xy = samples(alone)
            torch.testing.assert_close(alone.truth(torch.tensor([0]), xy)[0], grid.field.heights[tile].flatten())
            torch.testing.assert_close(grid.truth(torch.tensor([tile]), xy)[0], grid.field.heights[tile].flatten())


def test_the_levels_of_a_grid_span_the_difficulties_asked_for():
    grid = terrain_grid(["stairs_up"], 3, difficulty=(0.25, 0.75), resolution=0.5)
    assert grid.difficulty.tolist() == [0.25, 0.5, 0.75]
    assert terrain_grid(["stairs_up"], 1, difficulty=(0.25, 0.75), resolution=0.5).difficulty.tolist() == [0.75]
    with pytest.raises(ValueError, match="difficulty: must be"):
        terrain_grid(["stairs_up"], 2, difficulty=(0.0, 1.5))


def test_levels_go_up_on_success_and_down_on_failure():
    grid = terrain_grid(["flat"], 4, resolution=0.5)
    level = torch.tensor([0, 1, 2, 0, 1, 1])
    success = torch.tensor([True, True, False, False, False, True])
    failure = torch.tensor([False, False, True, True, False, True])
    assert grid.promote(level, success, failure).tolist() == [1, 2, 1, 0, 1, 2]


def test_who_masters_the_last_level_goes_anywhere():
    grid = terrain_grid(["flat"], 4, resolution=0.5)
    last, no = torch.full((20_000,), 3), torch.zeros(20_000, dtype=torch.bool)
    yes = ~no
    moved = grid.promote(last, yes, no, torch.Generator().manual_seed(0))
    for level in range(4):
        share = float((moved == level).float().mean())
        assert abs(share - 0.25) <= 5 * math.sqrt(0.25 * 0.75 / 20_000)
    assert torch.equal(grid.promote(last, yes, no, torch.Generator().manual_seed(0)), moved)
    assert torch.equal(grid.promote(last, no, no), last)


def test_one_level_is_the_hardest():
    assert terrain_grid(["rough"], 1, resolution=0.5).difficulty.tolist() == [1.0]


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="kind: must be one of flat, slope"):
        terrain("hills", 0.5)
    with pytest.raises(ValueError, match="difficulty"):
        terrain("flat", 1.1)
    with pytest.raises(ValueError, match="difficulty"):
        terrain("flat", float("nan"))
    with pytest.raises(ValueError, match="difficulty"):
        make_terrain("flat", torch.zeros(2, 2))
    with pytest.raises(ValueError, match="length"):
        terrain("flat", 0.5, length=8.03)
    with pytest.raises(ValueError, match="resolution: must be a positive"):
        terrain("flat", 0.5, resolution=-0.1)
    with pytest.raises(ValueError, match="kinds"):
        terrain_grid([], 3)
    with pytest.raises(ValueError, match="num_levels"):
        terrain_grid(["flat"], 0)


def test_host_reads_nothing_back():
    grid = terrain_grid(KINDS, 2, resolution=0.5)
    tensors = {name: getattr(grid, name).to("meta") for name in ("field", "kind_ids", "difficulty", "random")}
    grid = dataclasses.replace(grid, **tensors)
    level, flag = torch.empty(3, dtype=torch.int64, device="meta"), torch.empty(3, dtype=torch.bool, device="meta")
    with NoConstants(), OneDevice():
        assert grid.truth(grid.tile_ids(level, level), torch.empty(3, 7, 2, device="meta")).shape == (3, 7)
        assert grid.promote(level, flag, flag).shape == (3,)


def test_the_table_names_every_kind():
    assert all(f"| {kind} |" in (terrain_shapes.__doc__ or "") for kind in KINDS)


@pytest.mark.parametrize("level, kind, named", [(3, 0, "level"), (-1, 0, "level"), (0, 2, "kind"), (0, -1, "kind")])
def test_tiles_that_do_not_exist_are_refused(level, kind, named):
    grid = terrain_grid(["flat", "slope"], 3, length=4.0, resolution=0.1)
    assert grid.tile_ids(torch.tensor([2]), torch.tensor([1])).tolist() == [5]
    with pytest.raises(ValueError, match=f"{named}: must lie in"):
        grid.tile_ids(torch.tensor([level]), torch.tensor([kind]))
