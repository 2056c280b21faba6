"""Robots in the physics simulation: postures, and whether they stand."""

import math

import pytest
import torch

from tests.training.traversability.labels.ground import ROBOT, ledge, tile
from training.traversability.labels.stances import find_stances, ground_around


def test_drops_agree_where_it_is_plain():
    """On flat ground it stands, without ground under its hind feet it falls."""
    pytest.importorskip("mujoco")
    from training.traversability.labels.drop import drop, on_footholds, on_nominal_places

    xy, theta = torch.tensor([0.02, 0.01]), 0.3
    flat, cliff = tile(lambda x, y: 0.2), tile(lambda x, y: -1.0 * (x < 0.02))
    ground = ground_around(flat, 0, xy[None], ROBOT)
    feet = find_stances(ground, xy[None], torch.tensor([theta]), ROBOT).feet[0]
    posture = on_footholds(flat, 0, feet, xy, theta, ROBOT)
    assert posture.position.tolist() == pytest.approx([0.02, 0.01, 0.5], abs=0.001)
    outcome = drop(flat, 0, posture, ROBOT, 0.9)
    assert outcome.stood(ROBOT) and outcome.moved < 0.002 and outcome.tilted < 0.002
    assert not drop(cliff, 0, on_nominal_places(cliff, 0, xy, 0.0, ROBOT), ROBOT, 0.9).stood(ROBOT)


def test_nominal_postures_keep_to_what_legs_can_do():
    """A foot over a hole hangs half a step below the body's plane, which is no steeper than its limit."""
    from training.traversability.labels.drop import on_nominal_places, rest_heights

    hole, middle = tile(lambda x, y: -1.0 * ((x > 0.2) & (y > 0.1))), torch.zeros(2)
    posture = on_nominal_places(hole, 0, middle, 0.0, ROBOT)
    assert math.acos(float(posture.rotation[2, 2])) == pytest.approx(0.5, abs=1e-4)
    x, y, z = (posture.rotation.t() @ (posture.balls - posture.position).t()) / posture.rotation[2, 2]
    below = z + ROBOT.clearance - ROBOT.foot_radius / posture.rotation[2, 2]  # the body's plane, vertically
    # Without limits the gradient is (-1 / 1.4, -1 / 0.8), of which 0.3795 are kept, and the hind right foot 0.25 below.
    assert below.tolist() == pytest.approx([-0.1, 0.1, -0.25 + (1 - 0.3795) * 0.5, 0.1], abs=1e-3)
    over = posture.balls[:, 2] - rest_heights(hole, 0, posture.balls[:, :2], ROBOT.foot_radius)
    assert float(over.min()) == pytest.approx(0.0005, abs=1e-5) and over[0] > 0.5


def test_a_body_that_touches_does_not_stand():
    pytest.importorskip("mujoco")
    from training.traversability.labels.drop import Outcome, drop, on_nominal_places

    box = tile(lambda x, y: 0.31 * ((x.abs() < 0.08) & (y.abs() < 0.05)))
    outcome = drop(box, 0, on_nominal_places(box, 0, torch.zeros(2), 0.0, ROBOT), ROBOT, 0.9)
    assert outcome.touched and not outcome.stood(ROBOT)
    assert Outcome(0.04, 0.09, False).stood(ROBOT) and not Outcome(0.04, 0.09, True).stood(ROBOT)
    assert not Outcome(0.06, 0.09, False).stood(ROBOT) and not Outcome(0.04, 0.11, False).stood(ROBOT)


def test_a_robot_slides_where_the_friction_does_not_hold():
    pytest.importorskip("mujoco")
    from training.traversability.labels.drop import drop, on_nominal_places

    slope = tile(lambda x, y: 0.5 * x)
    posture = on_nominal_places(slope, 0, torch.tensor([0.0, 0.0]), 0.0, ROBOT)
    assert torch.allclose(posture.rotation[:, 2], torch.tensor([-0.5, 0.0, 1.0]) / math.sqrt(1.25), atol=1e-4)
    assert drop(slope, 0, posture, ROBOT, 0.55).stood(ROBOT)
    assert not drop(slope, 0, posture, ROBOT, 0.4).stood(ROBOT)


def test_legs_that_cut_the_ground_are_counted():
    from training.traversability.labels.drop import has_clear_legs, on_footholds

    posture = on_footholds(tile(lambda x, y: 0.0), 0, torch.tensor(
        [[0.25, 0.2, 0], [0.25, -0.2, 0], [-0.35, -0.2, 0], [-0.35, 0.2, 0]]), torch.zeros(2), 0.0, ROBOT)  # fmt: skip
    wall = tile(lambda x, y: 0.25 * ((x > 0.28) & (x < 0.33)))  # between front feet and the corners above them
    assert has_clear_legs(tile(lambda x, y: 0.0), 0, posture, ROBOT) and not has_clear_legs(wall, 0, posture, ROBOT)


def test_balls_rest_on_what_they_touch_first():
    from training.traversability.labels.drop import rest_heights

    ball = rest_heights(ledge(0.1), 0, torch.tensor([[-1.0, 0.0], [1.0, 0.0]]), 0.03)
    assert ball.tolist() == pytest.approx([0.03, 0.13], abs=1e-6)
    slope = rest_heights(tile(lambda x, y: 0.5 * x), 0, torch.tensor([[0.1, 0.0]]), 0.03)
    assert float(slope) == pytest.approx(0.05 + 0.03 * math.sqrt(1.25), abs=2e-4)
