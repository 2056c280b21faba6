"""How the robots of TerrainNav move."""

import math

import pytest
import torch

from envs.terrain_nav.robot import Ground, RobotState, advance, base_pose
from tests.envs.terrain_nav_cases import IDS, ROBOT, field_of, flat


def standing(x=0.0, y=0.0, yaw=0.0):
    no = torch.zeros(1, dtype=torch.bool)
    return RobotState(torch.tensor([[x, y]]), torch.tensor([yaw]), torch.zeros(1, 2), no, no, no)


def drive(field, action, seconds, state=None):
    """Drive one robot; return its states at 20 Hz."""
    ground, states = Ground(field, ROBOT.reach), [state or standing()]
    for _ in range(round(seconds / 0.05)):
        states.append(advance(states[-1], torch.tensor([action]), IDS, ground, ROBOT, 0.05))
    return states


def test_velocity_approaches_the_command():
    states = drive(field_of(flat), (1.0, 0.0), 1.0)
    v, x = 0.0, 0.0
    for state in states[1:]:
        v += (1.0 - v) * 0.25  # dt / response
        x += v * 0.05
        assert float(state.velocity[0, 0]) == pytest.approx(v, abs=1e-5)
        assert float(state.xy[0, 0]) == pytest.approx(x, abs=1e-5)


def test_backward_is_slower_and_turning_turns_left():
    back = drive(field_of(flat), (-1.0, 0.0), 3.0)[-1]
    assert float(back.velocity[0, 0]) == pytest.approx(-1 / 3, abs=1e-3)
    turned = drive(field_of(flat), (0.0, 1.0), 3.0)[-1]
    assert float(turned.velocity[0, 1]) == pytest.approx(1.5, abs=1e-3)
    assert float(turned.yaw[0]) > 3.5 and turned.xy.abs().max() < 1e-6


@pytest.mark.slow(1)
@pytest.mark.parametrize("rise, passes", [(0.1, True), (0.15, True), (0.3, False), (0.7, False)])
def test_low_steps_are_climbed_and_high_ones_block(rise, passes):
    last = drive(field_of(lambda x, y: rise * (x > 1.0)), (1.0, 0.0), 6.0)[-1]
    assert bool(last.blocked[0]) != passes and not bool(last.fallen[0])
    if passes:
        assert float(last.xy[0, 0]) > 2.0
    else:  # the footprint stops before the step, less than its reach and a substep away
        assert 0.6 - 0.1 < float(last.xy[0, 0]) + 0.3 + 0.1 - 0.3 <= 0.75


@pytest.mark.parametrize("drop, falls", [(0.15, False), (0.25, False), (0.5, True), (1.0, True)])
def test_deep_drops_are_falls(drop, falls):
    states = drive(field_of(lambda x, y: -drop * (x > 1.0)), (1.0, 0.0), 4.0)
    assert bool(states[-1].fallen[0]) == falls
    if falls:  # it stays where it fell, at the edge
        assert 0.5 < float(states[-1].xy[0, 0]) < 0.8
        assert states[-1].velocity.abs().max() == 0


def test_slopes_slow_down():
    gentle, steep = (drive(field_of(lambda x, y, g=g: g * x), (1.0, 0.0), 2.0)[-1].xy[0, 0] for g in (0.1, 0.4))
    assert float(steep) < 0.7 * float(gentle)


def test_base_pose_on_a_slope():
    field = field_of(lambda x, y: 0.2 * x + 0.1 * y)
    T = base_pose(torch.tensor([[0.5, -0.3]]), torch.tensor([0.7]), IDS, field, ROBOT)[0].double()
    normal = torch.tensor([-0.2, -0.1, 1.0], dtype=torch.float64)
    assert torch.allclose(T[:3, 2], normal / normal.norm(), atol=1e-4)
    assert torch.allclose(T[:3, :3] @ T[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-5)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(0.7, abs=1e-5)
    assert float(T[2, 3]) == pytest.approx(0.2 * 0.5 - 0.1 * 0.3 + 0.45, abs=1e-4)


def test_substeps_are_steps():
    """Also of robots that are blocked, or fall, in one of them."""
    ground = Ground(field_of(lambda x, y: 0.5 * (x > 1.0) - 0.8 * (x < -1.0)), ROBOT.reach)  # a wall and a pit
    no, xy = torch.zeros(8, dtype=torch.bool), torch.linspace(-0.8, 0.8, 8)[:, None] * torch.tensor([1.0, 0.2])
    yaw = torch.pi * (xy[:, 0] < 0)  # the others face the wall
    first = RobotState(xy, yaw, torch.tensor([[1.0, 0.3]]).repeat(8, 1), no, no, no)
    action, ids = torch.tensor([[1.0, 0.5]]).repeat(8, 1), IDS.repeat(8)
    one_by_one, blocked = first, no
    for _ in range(6):
        one_by_one = advance(one_by_one, action, ids, ground, ROBOT, 0.05)
        blocked = blocked | one_by_one.blocked
    at_once = advance(first, action, ids, ground, ROBOT, 0.05, substeps=6)
    assert blocked.any() and one_by_one.fallen.any() and torch.equal(at_once.blocked, blocked)
    for name in ("xy", "yaw", "velocity", "fallen"):
        torch.testing.assert_close(getattr(at_once, name), getattr(one_by_one, name), rtol=0, atol=1e-6)
