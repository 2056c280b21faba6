"""Scenes with ceilings and floors above each other: ground and ceiling are where vertical rays hit them."""

import math

import pytest
import torch

from torchelev.sim.exact import covered_scenes as scenes
from torchelev.sim.exact.sensors import cast


@pytest.mark.parametrize("scene", scenes.all_scenes(), ids=lambda scene: scene.name)
def test_vertical_rays_hit_ground_and_ceiling(scene):
    xy = places(scene)
    for feet in (0.05, 1.45, 2.9):  # where a robot may stand
        ground = scene.truth(xy, below=feet)
        ceiling = scene.ceiling(xy, ground)
        free = ~within(scene, xy, ground + 2e-3)
        assert free.float().mean() > 0.5
        for place, low, high in zip(xy[free], ground[free], ceiling[free], strict=True):
            start = torch.stack([place[0], place[1], low + 1e-3])
            up = cast(scene, start, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), 50.0)[0] + 1e-3
            down = cast(scene, start + torch.tensor([0, 0, 1e-3]), torch.tensor([[0.0, 0.0, -1.0]]).double(), 50.0)[0]
            assert down == pytest.approx(2e-3, abs=1e-4)
            assert up == pytest.approx(float(high - low), abs=1e-4) if math.isfinite(high) else not math.isfinite(up)


def places(scene):
    """Some places anywhere (N, 2), and one above each box."""
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(
        [
            [[-2.5, -2.5, 0.0]] * 40 + [box.low for box in scene.boxes],
            [[5.5, 5.5, 0.0]] * 40 + [box.high for box in scene.boxes],
        ]
    ).double()[..., :2]
    return torch.lerp(low, high, torch.rand(low.shape, dtype=torch.float64, generator=generator))


def within(scene, xy, z):
    """Which places lie in a box: `below` leaves out walls that are higher."""
    inside = torch.zeros(len(xy), dtype=torch.bool)
    for box in scene.boxes:
        inside |= box.covers(*xy.unbind(-1)) & (box.low[2] < z) & (z < box.high[2])
    return inside


def at(*xy):
    return torch.tensor([xy], dtype=torch.float64)


def test_a_robot_fits_under_the_table_but_not_through_its_legs():
    scene = scenes.table(0.74)
    assert float(scene.truth(at(2.0, 0.0))) == 0.0
    assert float(scene.ceiling(at(2.0, 0.0), torch.zeros(1))) == 0.74
    assert float(scene.truth(at(1.22, -0.44))) == 0.74
    assert math.isinf(scene.ceiling(at(0.0, 0.0), torch.zeros(1)))


def test_the_bridge_has_a_deck_and_a_road():
    scene, deck = scenes.bridge(), 12 * 0.17
    assert float(scene.truth(at(0.0, 0.0))) == pytest.approx(deck)
    assert float(scene.truth(at(0.0, 0.0), below=1.0)) == 0.0
    assert float(scene.ceiling(at(0.0, 0.0), torch.zeros(1))) == pytest.approx(deck - 0.25)
    assert float(scene.truth(at(0.0, 2.0))) == 0.0 and float(scene.truth(at(2.1, 0.0))) == pytest.approx(deck)
    heights = scene.truth(torch.tensor([[x, 0.0] for x in (-5.6, -3.0, 0.0, 3.0, 5.6)]))
    torch.testing.assert_close(heights, heights.flip(0))


def test_the_third_flight_of_the_stairwell_lies_above_the_first():
    scene = scenes.stairwell()
    place = at(1.0, 0.6)
    first, third = scene.truth(place, below=1.4), scene.truth(place)
    assert float(first) == pytest.approx(0.68) and float(third - first) == pytest.approx(2 * 8 * 0.17)
    assert 2.0 < float(scene.ceiling(place, first) - first) < 2.6
    along = torch.tensor([[x, 0.6] for x in torch.linspace(0.1, 2.2, 9).tolist()])
    assert (scene.truth(along, below=1.4).diff() >= 0).all()
    back = torch.tensor([[x, -0.6] for x in torch.linspace(2.2, 0.1, 9).tolist()])
    assert (scene.truth(back, below=2.8).diff() >= 0).all()


def test_door_and_culvert_leave_the_gaps_that_they_say():
    door, culvert, ground = scenes.door(1.8, 2.4), scenes.culvert(0.9), torch.zeros(1)
    assert float(door.ceiling(at(2.1, 0.0), ground)) == 1.8 and float(door.ceiling(at(1.0, 0.0), ground)) == 2.4
    assert float(door.truth(at(2.1, 0.6))) == 2.4
    assert float(culvert.ceiling(at(4.0, 0.0), ground)) == 0.9 and float(culvert.truth(at(4.0, 0.0))) == 1.6
    assert float(culvert.truth(at(4.0, 0.0), below=1.0)) == 0.0 and float(culvert.truth(at(4.0, 2.0))) == 1.6
