"""Where cells are, and moving the window."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import nans, pose, random_state, small_config, small_map
from torchelev import GridConfig
from torchelev.grid import cell_centers, locate
from torchelev.stages.cells import PointCells, center_offsets, lattice_offset
from torchelev.stages.recenter.stage import recenter, window_corner
from torchelev.state import BLANK, LAYERS, blank_state

SEEDS = st.integers(0, 10_000)
SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9))


def moved_to(emap, x, y, z=1.0):
    """The measurement of a robot at these places (B,) that sees nothing."""
    T = pose(num_envs=emap.num_envs)
    for axis, value in enumerate((x, y, z)):
        T[:, axis, 3] = torch.as_tensor(value, dtype=torch.float64)
    return emap.measure(nans(emap.num_envs), T, T, 0.0)


@given(SEEDS, SIZES, st.integers(1, 3), st.sampled_from([torch.float32, torch.float64]))
def test_recenter_agrees_with_the_reference(seed, cells, num_envs, dtype):
    rng = np.random.default_rng(seed)
    emap = small_map(num_envs, cells, dtype=dtype)
    state = random_state(rng, emap.cfg.grid, num_envs, dtype=dtype)
    position = rng.uniform(-0.8, 0.8, (2, num_envs))
    after = recenter(state, moved_to(emap, *position), emap.cfg.grid)
    for b in range(num_envs):
        corner = reference.window_corner(*position[:, b], 0.1, cells)
        assert tuple(after.corner[b].tolist()) == corner
        for name in LAYERS:
            old = getattr(state, name)[b].numpy()
            expected = reference.recenter(old, state.corner[b].tolist(), corner, BLANK.get(name, 0.0))
            np.testing.assert_array_equal(getattr(after, name)[b].numpy(), expected, err_msg=name)


def test_world_fixed_cells_keep_their_value_to_the_bit():
    """Each environment moves by its own shift, with NaN clouds; a cell of the world never changes its bits."""
    emap = small_map(3, raycast=None, overlap=None)
    state = random_state(np.random.default_rng(0), emap.cfg.grid, 3, dtype=torch.float32)
    emap.load_state(state)
    before, places = emap.layer("elevation"), emap.cell_centers()
    T = pose(num_envs=3)
    T[:, :2, 3] = torch.tensor([[0.31, -0.2], [-0.47, 0.0], [0.0, 0.12]])
    emap.update(nans(3), T, T, 0.1)
    after, seen = emap.layer("elevation"), 0
    for b in range(3):
        old = {tuple(p): v for p, v in zip(places[b].view(-1, 2).tolist(), before[b].flatten().tolist(), strict=True)}
        new = zip(emap.cell_centers()[b].view(-1, 2).tolist(), after[b].flatten().tolist(), strict=True)
        for place, value in new:
            expected = old.get(tuple(place), float("nan"))
            assert value == expected or (np.isnan(value) and np.isnan(expected))
            seen += value == value
    assert seen > 50 and emap.corner.tolist() == [[-3, -7], [-11, -5], [-6, -4]]


@given(SEEDS)
def test_there_and_back_forgets_only_what_left(seed):
    rng = np.random.default_rng(seed)
    emap = small_map(2)
    state = random_state(rng, emap.cfg.grid, 2)
    state = recenter(state, moved_to(emap, 0.0, 0.0), emap.cfg.grid)
    shift = rng.integers(-11, 12, 2) * 0.1
    away = recenter(state, moved_to(emap, *shift), emap.cfg.grid)
    back = recenter(away, moved_to(emap, 0.0, 0.0), emap.cfg.grid)
    kept = back.validity
    assert torch.equal(back.elevation[kept], state.elevation[kept])
    share = max(0, 12 - abs(round(shift[0] * 10))) * max(0, 10 - abs(round(shift[1] * 10)))
    assert (kept.sum((1, 2)) <= share).all()
    assert torch.equal(kept.sum((1, 2)), away.validity.sum((1, 2)))


@pytest.mark.parametrize("far", [1e3, 1e6, -1e9])
def test_a_jump_of_more_than_a_window_blanks_everything(far):
    emap = small_map(1)
    state = random_state(np.random.default_rng(0), emap.cfg.grid, known=1.0)
    after = recenter(state, moved_to(emap, far, 0.0), emap.cfg.grid)
    blank = blank_state(emap.cfg.grid, 1, "cpu", torch.float64)
    for name in LAYERS:
        assert torch.equal(getattr(after, name), getattr(blank, name)), name


def test_without_a_base_the_window_stays():
    emap = small_map(1)
    m = emap.measure(nans(1), pose((5, 5, 1)), None, 0.0)
    assert recenter(emap.state, m, emap.cfg.grid) == emap.state


@given(SEEDS, SIZES)
def test_locate_agrees_with_the_reference(seed, cells):
    rng = np.random.default_rng(seed)
    grid = small_config(cells).grid
    xy = rng.uniform(-1, 1, (1, 50, 2))
    corner = rng.integers(-8, 3, 2)
    slot, inside = locate(*torch.from_numpy(xy).unbind(-1), torch.from_numpy(-corner[None] * 0.1), grid)
    for n in range(50):
        cell = reference.cell_of(*xy[0, n], corner, 0.1, cells)
        assert bool(inside[0, n]) == (cell is not None)
        i, j = cell or np.clip(np.floor(xy[0, n] / 0.1) - corner, 0, np.array(cells) - 1)
        assert slot[0, n] == i * cells[1] + j


def test_point_cells_sum_and_take():
    grid = small_config((2, 2), 1.0).grid
    xy = torch.tensor([[[0.5, 0.5], [0.6, 0.1], [1.5, 0.5], [9.0, 0.0]]])
    slot, inside = locate(*xy.unbind(-1), torch.zeros(1, 2), grid)
    cells = PointCells(slot.to(torch.int64), inside, grid.num_cells)
    totals, number = cells.sums(torch.tensor([[1.0, 2.0, 4.0, 0.0]]), cells.inside.float())
    assert totals.tolist() == [[3, 0, 4, 0]] and number.tolist() == [[2, 0, 1, 0]]
    (at_points,) = cells.take(totals)
    assert at_points[:, :3].tolist() == [[3, 3, 4]]


@given(st.floats(-50, 50), st.floats(-50, 50), SIZES)
def test_window_corner_is_within_half_a_cell(x, y, cells):
    grid = small_config(cells).grid
    base = torch.tensor([[x, y]], dtype=torch.float64)
    corner = window_corner(base, torch.zeros(1, 2, dtype=torch.int64), grid)
    center = (corner + torch.tensor(cells, dtype=torch.float64) / 2) * 0.1
    assert ((center - base).abs() <= 0.05 + 1e-9).all()


def test_centers_lie_on_the_lattice():
    emap = small_map(2, (5, 4))
    emap.update(nans(2), pose((0.33, 7.77, 1), num_envs=2), pose((0.33, 7.77, 1), num_envs=2), 0.1)
    lattice = emap.cell_centers() / 0.1 - 0.5
    assert (lattice - lattice.round()).abs().max() < 1e-9
    middle = emap.cell_centers()[0].view(-1, 2).mean(0)
    torch.testing.assert_close(middle, emap.center[0, :2])
    i, j = 3, 1  # the contract: centre = center + (i + 0.5 - H/2) * resolution, i with x, j with y
    expected = emap.center[0, :2] + (torch.tensor([i, j]) + 0.5 - torch.tensor([5, 4]) / 2) * 0.1
    torch.testing.assert_close(emap.cell_centers()[0, i, j], expected)


def test_center_offsets_count_from_the_anchor():
    emap = small_map(1, (4, 3), dtype=torch.float64)
    m = moved_to(emap, 12.34, -5.67)
    state = recenter(emap.state, m, emap.cfg.grid)
    x, y = center_offsets(state, m, emap.cfg.grid)
    places = cell_centers(state.corner, emap.cfg.grid)
    torch.testing.assert_close(x[0, :, 0] + m.anchor[0, 0] * 0.1, places[0, :, 0, 0])
    torch.testing.assert_close(y[0, 0] + m.anchor[0, 1] * 0.1, places[0, 0, :, 1])
    torch.testing.assert_close(lattice_offset(state, m, emap.cfg.grid), ((m.anchor - state.corner) * 0.1).double())


@pytest.mark.parametrize(
    "bad", [dict(resolution=0.0), dict(resolution=-0.1), dict(length_x=1.05), dict(length_y=0.04), dict(length_x=-1.0)]
)
def test_grid_refuses(bad):
    with pytest.raises(ValueError, match=f"grid.{next(iter(bad))}"):
        GridConfig(**{"resolution": 0.1, "length_x": 1.0, "length_y": 1.0, **bad})


def test_grid_refuses_infinite_lengths():
    with pytest.raises(ValueError, match="grid.length_x"):
        GridConfig(length_x=float("inf"))


def test_grid_counts_cells_despite_rounding():
    grid = GridConfig(resolution=0.1, length_x=0.3, length_y=0.7)
    assert (grid.height, grid.width, grid.num_cells) == (3, 7, 21)
