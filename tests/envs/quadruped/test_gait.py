"""The trot."""

import torch

from envs.quadruped.config import GaitConfig
from envs.quadruped.gait import foot_positions, joint_targets
from envs.quadruped.kinematics import feet_from_joints

GAIT = GaitConfig()


def test_standing_feet_move_backwards_at_the_commanded_speed():
    command, step = torch.tensor([[0.5, 0.0, 0.0]]), 0.001
    before, after = (foot_positions(torch.tensor([p]), command, GAIT) for p in (0.1, 0.1 + step))
    seconds = step / GAIT.frequency
    # At a phase of 0.1 the diagonal of front left and rear right stands, and the other one, at 0.6, begins to swing.
    speed = (after - before)[0, [0, 3], 0] / seconds
    torch.testing.assert_close(speed, torch.full((2,), -0.5), atol=1e-2, rtol=0)


def test_a_foot_is_lifted_by_the_swing_height_and_lands_where_it_began():
    command = torch.tensor([[0.5, 0.1, 0.3]])
    phases = torch.linspace(0, 1, 401)
    feet = torch.cat([foot_positions(p[None], command, GAIT) for p in phases])
    lift = feet[..., 2].amax(0) - feet[..., 2].amin(0)
    torch.testing.assert_close(lift, torch.full((4,), GAIT.swing_height), atol=1e-3, rtol=0)
    torch.testing.assert_close(feet[0], feet[-1], atol=1e-5, rtol=0)
    assert (feet.diff(dim=0).abs().amax() < 0.01).all(), "feet jump"


def test_a_robot_that_is_asked_to_stand_lifts_no_foot():
    still = torch.zeros(1, 3)
    a, b = (foot_positions(torch.tensor([p]), still, GAIT) for p in (0.0, 0.8))
    torch.testing.assert_close(a, b)


def test_mirrored_commands_give_mirrored_feet():
    left = foot_positions(torch.tensor([0.3]), torch.tensor([[0.4, 0.2, 0.5]]), GAIT)
    right = foot_positions(torch.tensor([0.8]), torch.tensor([[0.4, -0.2, -0.5]]), GAIT)
    torch.testing.assert_close(left, right[:, [1, 0, 3, 2]] * torch.tensor([1.0, -1.0, 1.0]))


def test_joint_targets_put_the_feet_where_the_action_asks():
    phase, command = torch.tensor([0.2]), torch.tensor([[0.3, 0.0, 0.1]])
    action = torch.tensor([[0.1, 0.2, 0.3] * 4])
    feet = feet_from_joints(joint_targets(action, phase, command, GAIT))
    expected = foot_positions(phase, command, GAIT) + 0.1 * torch.tensor([0.08, 0.1, 0.24])
    torch.testing.assert_close(feet, expected, atol=1e-5, rtol=0)
    largest, larger = (joint_targets(torch.full((1, 12), size), phase, command, GAIT) for size in (3.0, 9.0))
    torch.testing.assert_close(larger, largest)
