"""The scenes' truth: heights, steps, and that no terrain is steeper than it says."""

import math

import pytest
import torch

from torchelev.sim import Box, Scene
from torchelev.sim.exact import scenes

ALL = [
    scenes.flat(), scenes.slope(), scenes.rough(0), scenes.stairs(), scenes.boxes(0), scenes.mixed(0), scenes.wall(),
    scenes.overhang(), scenes.person(), scenes.two_floors(),
]  # fmt: skip


@pytest.mark.parametrize("scene", ALL, ids=lambda scene: scene.name)
def test_terrain_is_no_steeper_than_declared(scene):
    x, y = 8 * torch.rand(2, 5000, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 4
    h = 1e-6
    gx = (scene.terrain(x + h, y) - scene.terrain(x - h, y)) / (2 * h)
    gy = (scene.terrain(x, y + h) - scene.terrain(x, y - h)) / (2 * h)
    assert float(torch.hypot(gx, gy).max()) <= scene.steepness + 1e-6


def test_height_keeps_the_shape_it_is_given():
    x = torch.zeros(2, 3, 4, dtype=torch.float64)
    assert scenes.mixed(0).height(x, x).shape == (2, 3, 4)
    assert scenes.flat().truth(torch.zeros(5, 2)).shape == (5,)


def test_slope_is_a_plane():
    xy = torch.tensor([[1.0, 2.0], [-2.0, 0.5]])
    torch.testing.assert_close(scenes.slope(10.0).truth(xy), math.tan(math.radians(10.0)) * xy[:, 0].double())


def test_stairs_are_exact_steps():
    edge = 0.613 + 2 * 0.29
    z = scenes.stairs().truth(torch.tensor([[edge - 1e-6, 0.0], [edge + 1e-6, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(z, torch.tensor([0.34, 0.51], dtype=torch.float64))


def test_rough_ground_is_about_8_cm():
    for seed in range(3):
        z = scenes.rough(seed).truth(12 * torch.rand(20000, 2) - 6)
        assert 0.05 < float(z.abs().max()) < 0.14


def test_a_floating_box_is_no_ground_but_covers():
    scene = scenes.overhang()
    under_bar = torch.tensor([[1.45, 0.0]])
    assert float(scene.truth(under_bar)) == 0.0
    assert bool(scene.is_covered(under_bar)) and not bool(scene.is_covered(torch.tensor([[0.5, 0.0]])))


def test_person_goes():
    scene = scenes.person(until=3.0)
    place = torch.tensor([[1.9, 0.0]])
    assert bool(scene.is_covered(place, t=2.9)) and not bool(scene.is_covered(place, t=3.0))


def test_a_box_moves():
    scene = Scene(boxes=(Box(low=(0, 0, -1), high=(1, 1, 0.5), velocity=(1.0, 0, 0), grounded=True),))
    place = torch.tensor([[1.5, 0.5]])
    assert [float(scene.truth(place, t)) for t in (0.0, 1.0, 2.0)] == [0.0, 0.5, 0.0]


def test_floors_of_a_building():
    scene = scenes.two_floors()
    place = torch.tensor([[0.0, 0.0]])
    assert float(scene.truth(place)) == 2.72
    assert float(scene.truth(place, below=1.5)) == 0.0
