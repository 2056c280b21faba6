"""Stances: which footholds robots take, and how steep their bodies are."""

import pytest
import torch

from tests.training.traversability.labels.ground import ROBOT, tile
from training.traversability.labels.stances import VERDICTS, find_stances, ground_around, is_gentle, plane_through


def test_a_foot_may_stand_on_either_level():
    """On the lower level three feet would be far from the ledge; the fourth takes what is nearest and fits."""
    field = tile(lambda x, y: -1.0 * ((x > 0.29) & (y > 0.14)))  # a drop under the front left foot
    ground = ground_around(field, 0, torch.zeros(1, 2), ROBOT)
    found = find_stances(ground, torch.tensor([[0.0, 0.003]]), torch.zeros(1), ROBOT)
    assert VERDICTS[found.verdict] == "stands"
    front_left, *others = found.feet[0].tolist()
    assert front_left[2] == pytest.approx(0, abs=0.01) and (front_left[0] < 0.29 or front_left[1] < 0.14)
    assert [foot[2] for foot in others] == [0, 0, 0]
    assert torch.tensor(others)[:, :2].tolist() == [
        pytest.approx(place, abs=0.011) for place in ([0.35, -0.2], [-0.35, -0.2], [-0.35, 0.2])
    ]


def test_a_body_is_as_steep_as_the_plane_through_its_feet():
    """0.7 tan(0.5) = 0.3824; a twist, 0.3 up on the diagonal, is level."""
    xy = [[0.35, 0.2], [0.35, -0.2], [-0.35, -0.2], [-0.35, 0.2]]
    heights = [[0.382, 0.382, 0, 0], [0.383, 0.383, 0, 0], [0.3, 0, 0.3, 0], [0.0, 0.0, 0.22, -0.22]]
    feet = torch.tensor([[[*p, z] for p, z in zip(xy, row, strict=True)] for row in heights])
    plane = plane_through(feet)
    assert plane.gradient.t().flatten().tolist() == pytest.approx([0.382 / 0.7, 0, 0.383 / 0.7, 0, 0, 0, 0, -0.55])
    assert is_gentle(plane, ROBOT).tolist() == [True, False, True, False]
