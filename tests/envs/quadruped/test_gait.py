"""The trot and its inverse kinematics."""

import mujoco
import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from envs.quadruped.config import GaitConfig
from envs.quadruped.gait import feet_from_joints, foot_positions, joint_angles
from envs.quadruped.physics import ROBOT
from envs.quadruped.proprioception import feet_in_base

GAIT = GaitConfig()


def angles(seed, count=16):
    """Draw joint angles with feet well below the hips."""
    u = torch.rand(count, 4, 3, generator=torch.Generator().manual_seed(seed))
    low, high = torch.tensor([-0.5, -0.1, -1.9]), torch.tensor([0.5, 1.2, -0.8])
    return (low + (high - low) * u).flatten(1)


@given(st.integers(0, 1000))
def test_the_inverse_kinematics_inverts_the_forward_one(seed):
    q = angles(seed)
    torch.testing.assert_close(joint_angles(feet_from_joints(q)), q, atol=1e-4, rtol=0)


def test_the_forward_kinematics_is_that_of_the_model():
    model = mujoco.MjModel.from_xml_path(str(ROBOT))
    data = mujoco.MjData(model)
    q = angles(0, 1)
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *q[0].tolist()]
    mujoco.mj_forward(model, data)
    feet = np.stack([data.site(f"{leg}_foot").xpos for leg in ("FL", "FR", "RL", "RR")])
    np.testing.assert_allclose(feet_in_base(feet_from_joints(q))[0].numpy(), feet, atol=1e-5)


def test_a_foot_out_of_reach_gives_finite_angles():
    feet = torch.tensor([[0.0, 0.08, -2.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.08, 0.5]])[None]
    assert joint_angles(feet).isfinite().all()


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
