"""Walls and steps within a cell; the height update's tests compare whole cells with the reference."""

import math

import pytest
import torch

from torchelev.ops.windows import AROUND, around
from torchelev.stages.fusion.config import EdgeConfig
from torchelev.stages.fusion.consensus import resolve_contested
from torchelev.stages.fusion.contested import NO_HEIGHT, CellHeights, ContestedCells
from torchelev.stages.fusion.edges import ends_of_step, lie_behind, values_around


@pytest.mark.parametrize("degrees", range(0, 360, 24))
def test_neighbours_behind_a_cell_lie_within_50_degrees_of_its_rays(degrees):
    angle = math.radians(degrees)
    x, y = (torch.tensor([5.0 * part(angle)]) for part in (math.cos, math.sin))
    off = [abs(math.remainder(math.degrees(math.atan2(j, i)) - degrees, 360)) for i, j in AROUND]
    assert lie_behind(x, y, *around(x.device))[0].tolist() == [o < 50 for o in off]


def test_values_around():
    """Of two maps of 3 x 2 cells; outside a map there is nothing, the other map's cells least of all."""
    layer, cells = torch.arange(12.0).view(2, 6), torch.tensor([3, 4, 6])
    exists, (got,) = values_around([layer], cells, *around(layer.device), width=2)
    none = -1.0
    got = torch.where(exists, got, none)
    assert got[0].tolist() == [0, 1, none, 2, none, 4, 5, none]
    assert got[1].tolist() == [none, 2, 3, none, 5, none, none, none]
    assert got[2].tolist() == [none, none, none, none, 7, none, 8, 9]


def test_points_that_are_not_used_hold_no_level():
    """One return far above the step's top is an outlier, also if points that are not used lie as high."""
    z = torch.tensor([[0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 3.0, 3.0, 3.0]])
    weight = torch.tensor([[1.0] * 7 + [0.0] * 2])
    slot, cells, no_step = torch.zeros(1, 9, dtype=torch.int64), torch.tensor([[True]]), torch.tensor([[False]])
    ray, passed, mean = torch.ones(1, 9), torch.zeros(1, 9, dtype=torch.uint8), torch.tensor([[6 / 7]])
    find_ends = []
    for count in (7, 9):
        columns = [value[:, :count] for value in (z, torch.full((1, 9), 1e-4), weight, passed, ray, ray)]
        find_ends.append(ends_of_step(ContestedCells(cells, no_step, slot[:, :count], columns, mean), EdgeConfig()))
    assert find_ends[0] == find_ends[1]
    top, bottom = (mean.item() + end.item() for end in find_ends[0])
    assert top == pytest.approx(6 / 7)  # the next level, 1.5, would be reached by the outlier alone
    assert bottom == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("refinements, top", [(2, 0.875), (3, 0.9375), (7, 1 - 2**-8)])
def test_each_refinement_halves_the_distance_to_the_top_of_a_face(refinements, top):
    """A wall's face of 1 m, its points evenly spread; the bottom takes two."""
    z = torch.linspace(0, 1, 20_001, dtype=torch.float64)[None]
    slot, passed, cells = torch.zeros_like(z, dtype=torch.int64), torch.zeros_like(z), torch.tensor([[True]])
    columns = [z, torch.full_like(z, 1e-10), torch.ones_like(z), passed, passed, passed]
    points = ContestedCells(cells, ~cells, slot, columns, 0.5 * cells.double())
    find_ends = ends_of_step(points, EdgeConfig(refinements=refinements))
    assert [0.5 + end.item() for end in find_ends] == pytest.approx([top, 0.125], abs=1e-3)


def one_cell(z, weight, step=0, passed=0, seen=None, known=None):
    """Height and side of the middle cell of 3 x 3, with these points, whose rays go along +x.

    `seen` and `known` give its neighbours' heights in the scan and in the map, by number from 0 to 8.
    """
    z, weight = torch.tensor([z]), torch.tensor([weight])
    cells, zeros = torch.zeros(1, 9), torch.zeros_like(z)
    middle = (cells > 0).index_fill(1, torch.tensor([4]), True)
    scan, seen_before = torch.full_like(cells, NO_HEIGHT), torch.full_like(cells, NO_HEIGHT)
    mean = {4: (z * weight).sum() / weight.sum()}
    for layer, values in ((scan, (seen or {}) | mean), (seen_before, known or {})):
        for cell, height in values.items():
            layer[0, cell] = height
    columns = [z, zeros + 1e-4, weight, (zeros + passed).to(torch.uint8), zeros + 1.0, zeros]
    points = ContestedCells(middle & (step == 0), middle & (step > 0), (zeros + 4).to(torch.int64), columns, scan)
    results = resolve_contested(points, cells, CellHeights(scan, seen_before), 3, 3.0, 0.01, EdgeConfig())
    return [result[0, 4].item() for result in results]


def test_a_wall_without_a_cell_behind_it_stays():
    """Rays passed the cell's centre and hit the ground before it: that counts once the wall's top shows elsewhere.

    What nobody saw shows no top, although its height is zero and the wall lies below that.
    """
    points = [-5.0] * 6 + [-4.7] * 4, [1.0] * 10
    top, ground = pytest.approx([-4.7, 1.0]), pytest.approx([-5.0, -1.0])
    assert one_cell(*points, passed=1) == top
    assert one_cell(*points, passed=0, seen={3: -4.7}) == top
    assert one_cell(*points, passed=1, seen={3: -4.7}) == ground
    assert one_cell(*points, passed=1, known={7: -4.7}) == ground
    assert one_cell(*points, passed=1, known={1: -4.7}) == top  # before the wall, not behind it
    assert one_cell(*points, passed=1, seen={3: -5.0}, known={7: -5.0}) == top


def test_a_cell_marked_as_a_step_has_a_side():
    """Although all its points lie within the gate around their robust mean."""
    z = [0.0] * 6 + [0.02] * 4
    height, side = one_cell(z, [1.0] * 10, step=0)
    assert 0 < height < 0.01 and side == 0
    assert one_cell(z, [1.0] * 10, step=1) == pytest.approx([0.02, 1.0])


def test_a_face_is_a_step_although_no_point_lies_outside_the_gate():
    """The standard deviation is 1 cm, the gate 3 cm: an even spread over 5.8 cm is more than noise explains."""
    even = torch.linspace(0, 0.058, 12).tolist()
    height, side = one_cell(even, [1.0] * 12)
    assert side == 1 and 0.048 < height <= 0.058
    noise = (0.01 * torch.linspace(0.04, 0.96, 12).mul(2).sub(1).erfinv() * 2**0.5).tolist()
    height, side = one_cell(noise, [1.0] * 12)
    assert side == 0 and abs(height) < 1e-3


def test_points_that_are_not_used_hide_no_step():
    step = [0.0] * 6 + [0.3] * 4
    assert one_cell(step, [1.0] * 10, step=0) == pytest.approx([0.3, 1.0])
    assert one_cell(step + [0.0] * 40, [1.0] * 10 + [0.0] * 40, step=0) == pytest.approx([0.3, 1.0])
