"""Where the completion puts the edges of stairs: the scenes, the edges that count, and their errors."""

import json

import pytest
import torch
from click.testing import CliRunner

import training.completion.edges as edges
from torchelev.completion.complete import CompletionInput
from training.completion.edges import TRUE_CELLS, all_errors, find_edges, measure, table
from training.completion.maps import TrueMap
from training.completion.stairs import SeenStairs, Stairs, look_at

CELL, SIZE = 0.04, 100  # [m], cells


def seen_stairs(rise, known=lambda x: x > 10.0):
    """Stairs along the rows of a map, whose first edge is at its center; `known` returns which x [m] are."""
    stairs = Stairs(rise=rise, run=0.3)
    center = (torch.arange(SIZE) - (SIZE - 1) / 2) * CELL
    x, y = torch.meshgrid(center, center, indexing="ij")
    truth = stairs.scene.truth(torch.stack([x, y], -1)).float()[None]
    none = torch.zeros_like(truth)
    layers = CompletionInput(truth, known(x)[None], none, none, none > 0, none)
    maps = TrueMap(layers, truth, none == 0, CELL, ("stairs",), 1)
    return SeenStairs(maps, (stairs,), torch.eye(4, dtype=torch.float64)[None])


def half_of_each_tread(x):
    """Return which places are in the second half of a tread of 0.3 m."""
    return (x + 1.5).remainder(0.3) > 0.15


@pytest.mark.parametrize("rise", [0.2, -0.2])
def test_stairs_rise_or_fall_at_each_edge(rise):
    xy = torch.tensor([[-5.0, 0.0], [-0.01, 0.0], [0.01, 0.0], [0.31, 1.0], [1.49, 0.0], [1.51, 0.0], [9.0, 0.0]])
    expected = rise * torch.tensor([0.0, 0.0, 1.0, 2.0, 5.0, 6.0, 6.0])
    assert torch.allclose(Stairs(rise=rise, run=0.3).scene.truth(xy).float(), expected)


@pytest.mark.parametrize("rise", [0.2, -0.2])
def test_an_edge_that_is_shifted_errs_by_the_shift(rise):
    seen = seen_stairs(rise, half_of_each_tread)
    answers = {
        "true": lambda maps: (maps.truth, None),
        "late": lambda maps: (maps.truth.roll(2, 1), None),
        "early": lambda maps: (maps.truth.roll(-2, 1), None),
        "nowhere": lambda maps: (torch.full_like(maps.truth, -9.0 if rise > 0 else 9.0), None),
        "too soon": lambda maps: (torch.full_like(maps.truth, 9.0 if rise > 0 else -9.0), None),
    }
    errors = all_errors(answers, seen)
    assert len(errors["true"]) == 5 * 9, "five edges behind the first one, on nine lines"
    assert float(errors["true"].abs().max()) < CELL / 2 + 2e-3
    for name, shift in {"late": 2 * CELL, "early": -2 * CELL}.items():
        assert torch.allclose(errors[name], errors["true"] + shift, atol=2e-3)
    assert torch.allclose(errors["nowhere"], torch.tensor(0.15)) and torch.allclose(
        errors["too soon"], torch.tensor(-0.15)
    )


@pytest.mark.parametrize(
    ("known", "count"),
    [
        (half_of_each_tread, 5),
        (lambda x: x < 10.0, 0),  # wholly
        (lambda x: x > 10.0, 0),  # not at all
        (lambda x: (x + 1.5).remainder(0.3) < 0.06, 0),  # the faces of the risers
        (lambda x: half_of_each_tread(x) & (x < 0.6), 1),
    ],
)
def test_edges_count_whose_next_tread_was_seen_in_part(known, count):
    counts = [int(edge.counts.sum()) for _, edge in find_edges(seen_stairs(0.2, known))]
    assert sum(counts) == 9 * count


def test_figures_are_those_of_the_sizes_of_errors():
    found = measure(torch.tensor([-0.01, 0.01, 0.03, -0.05, 0.019]))
    assert found == {"edges": 5, "median": 0.019, "p90": pytest.approx(0.042), "within_2_cm": 0.6, "bias": 0.01}
    assert measure(torch.zeros(0)) == {"edges": 0}


def test_looks_repeat_and_measure_the_stairs():
    first, again = (look_at([Stairs(rise=-0.16, run=0.3)], 0.08, seed=0) for _ in range(2))
    maps = first.maps
    assert torch.equal(maps.layers.elevation, again.maps.layers.elevation)
    known = maps.layers.validity
    assert 0.1 < float(known.float().mean()) < 0.9
    assert float((maps.layers.elevation - maps.truth)[known].abs().median()) < 0.01
    assert any(bool(edge.counts.any()) for _, edge in find_edges(first))


@pytest.mark.slow(6)
def test_the_command_finds_that_the_shipped_weights_put_edges_better_than_the_nearest_heights(tmp_path):
    options, sizes = ["--seeds", "2", "--out", str(tmp_path / "edges.json")], edges.Sizes((0.16,), (0.3,), (0.04,))
    done = CliRunner().invoke(edges.main, options, obj=sizes, catch_exceptions=False)
    assert done.exit_code == 0 and "| down | 4 cm |" in done.output
    found = json.loads((tmp_path / "edges.json").read_text(), parse_constant=pytest.fail)
    down = found["down"]["0.04"]
    assert down["CompletionNet"]["edges"] > 20
    assert down[TRUE_CELLS]["p90"] < 0.02 < down["nearest"]["median"]
    assert down["CompletionNet"]["p90"] < down["nearest"]["median"]


def test_rows_without_edges_are_left_out():
    cells = {"edges": 0}
    some = measure(torch.tensor([0.01, -0.02]))
    rows = table({"up": {"0.02": {"a": cells}, "0.04": {"a": some}}, "down": {"0.02": {"a": cells}}}).split("\n")
    assert rows[0] == "| stairs | cells | edges | a |" and rows[2:] == ["| up | 4 cm | 2 | 1.0 / 1.9 / 100 |"]
