"""Which known cell fills an unknown one, with and without stopping early."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import never_wait
from tests.filters.filter_cases import (
    SEEDS,
    random_layer,
)
from tests.filters.inpainting.references import assert_filled, holes, minimum_reference, nearest_reference
from torchelev.filters.inpainting.holes import component_labels, lowest_of_border, roots
from torchelev.filters.inpainting.inpaint import (
    inpaint_minimum,
    inpaint_nearest,
)

DTYPES = [torch.float64, torch.float32]  # by tensors; by OpenCV


def spiral(size):
    """A corridor one cell wide that winds to the middle between walls: the hole with the longest way through it."""
    known = np.ones((size, size), bool)
    i, j, (u, v), turned = 0, 0, (0, 1), 0
    while turned < 2:
        known[i, j] = False
        ahead, beyond = (i + u, j + v), (i + 2 * u, j + 2 * v)
        blocked = not (0 <= ahead[0] < size and 0 <= ahead[1] < size)
        if not blocked and 0 <= beyond[0] < size and 0 <= beyond[1] < size:
            blocked = not known[beyond]
        if blocked:
            u, v, turned = v, -u, turned + 1
        else:
            i, j, turned = *ahead, 0
    return known


@pytest.fixture(params=[True, False])
def stops(request, monkeypatch):
    """As a CPU does, and as a device whose host may not wait."""
    if not request.param:
        never_wait(monkeypatch)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mirror", [[], [0], [1], [0, 1]])
def test_the_border_of_a_spiral_is_all_of_it_whatever_its_direction(mirror, dtype, stops):
    """The lowest wall is at its inner end, or outside of its outer one."""
    known = torch.from_numpy(spiral(41)).flip(mirror)
    assert len(holes(known.numpy())) == 1 and 600 < (~known).sum() < 1200
    for cell in (known.nonzero()[0], known.nonzero()[len(known.nonzero()) // 2]):
        heights = torch.where(known, 1.0, 0.0).to(dtype)
        heights[tuple(cell)] = 0.5
        filled, _ = inpaint_minimum((heights[None], known[None]))
        assert (filled[0][~known] == 0.5).all()


@given(SEEDS, st.integers(1, 60), st.floats(0.1, 1.5))
def test_parts_of_graphs(seed, count, edges):
    """Any graph, of which maps make few: each node gets the lowest that is connected to it."""
    rng = np.random.default_rng(seed)
    a, b = torch.from_numpy(rng.integers(0, count, (2, int(edges * count))))
    reach = np.eye(count, dtype=int)
    reach[a, b] = reach[b, a] = 1
    connected = np.linalg.matrix_power(reach.astype(float), count) > 0
    assert component_labels(a, b, count).tolist() == connected.argmax(1).tolist()


@pytest.mark.parametrize("order", ["up", "down", "star", "random"])
def test_parts_of_the_worst_graphs_within_all_steps(order, monkeypatch):
    """A chain in any order, and a star whose middle is the highest: the rounds suffice that never stop early."""
    never_wait(monkeypatch)
    nodes = {"up": torch.arange(1000), "down": torch.arange(1000).flip(0)}.get(order)
    nodes = torch.randperm(1000, generator=torch.Generator().manual_seed(0)) if nodes is None else nodes
    a, b = (torch.arange(999), torch.full((999,), 999)) if order == "star" else (nodes[1:], nodes[:-1])
    assert (component_labels(a, b, 1000) == 0).all()


def test_a_chain_is_followed_to_its_end(stops):
    assert (roots(torch.arange(-1, 999).clamp(min=0)) == 0).all()


def test_of_equally_low_border_cells_the_first_is_taken(stops):
    known = torch.tensor([[[True, True, True, True], [True, False, False, True], [True, True, True, True]]])
    heights = torch.tensor([[[2.0, 1, 1, 1], [1, 0, 0, 1], [1, 1, 1, 1]]])
    assert lowest_of_border(heights, known)[0, 1].tolist() == [4, 1, 1, 7]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.4, 0.6, 0.9, 1.0])
def test_all_steps_give_the_same_as_stopping(share, stops):
    layer = random_layer(3, (2, 13, 11), share)
    assert_filled(inpaint_minimum(layer), layer, minimum_reference)
    assert_filled(inpaint_nearest(layer), layer, nearest_reference)
