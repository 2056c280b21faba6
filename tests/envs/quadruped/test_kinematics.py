"""Forward and inverse kinematics of the legs, against MuJoCo's."""

import mujoco
import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from envs.quadruped.kinematics import (
    LEGS,
    LINK,
    LINKS,
    feet_from_joints,
    feet_in_base,
    joint_angles,
    joint_limits,
    link_poses,
)
from envs.quadruped.physics import ROBOT


def posed(q):
    """Return MuJoCo's data of the robot at the origin with joint angles (12,)."""
    model = mujoco.MjModel.from_xml_path(str(ROBOT))
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *q.tolist()]
    mujoco.mj_forward(model, data)
    return data


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
    q = angles(0, 1)
    data = posed(q[0])
    feet = np.stack([data.site(f"{leg}_foot").xpos for leg in LEGS])
    np.testing.assert_allclose(feet_in_base(q)[0].numpy(), feet, atol=1e-5)


def test_link_poses_are_those_of_the_model():
    q = angles(1, 2)
    found = link_poses(q)
    for k in range(2):
        data = posed(q[k])
        for link, T in zip(LINKS, found[k].numpy(), strict=True):
            np.testing.assert_allclose(T[:3, 3], data.body(link).xpos, atol=1e-5, err_msg=link)
            np.testing.assert_allclose(T[:3, :3].ravel(), data.body(link).xmat, atol=1e-5, err_msg=link)


def test_joint_limits_are_those_of_the_model():
    model = mujoco.MjModel.from_xml_path(str(ROBOT))
    limits = torch.stack(joint_limits(torch.device("cpu")), -1)
    torch.testing.assert_close(limits, torch.from_numpy(model.jnt_range[1:]).float())


@given(st.integers(0, 1000))
def test_all_places_within_the_joint_limits_are_reached(seed):
    low, high = joint_limits(torch.device("cpu"))
    q = low + (high - low) * torch.rand(64, 12, generator=torch.Generator().manual_seed(seed))
    thigh, knee = q.unflatten(-1, (4, 3))[..., 1:].unbind(-1)
    below = LINK * (torch.cos(thigh) + torch.cos(thigh + knee)) > 0.051
    feet = feet_from_joints(q)
    reached = feet_from_joints(joint_angles(feet))
    torch.testing.assert_close(reached[below], feet[below], atol=1e-4, rtol=0)


@given(st.integers(0, 1000))
def test_angles_keep_the_joint_limits_wherever_the_foot_should_be(seed):
    low, high = joint_limits(torch.device("cpu"))
    u = torch.rand(64, 4, 3, generator=torch.Generator().manual_seed(seed))
    q = joint_angles(1.2 * (u - 0.5))
    assert ((q >= low - 1e-6) & (q <= high + 1e-6)).all()


def test_a_foot_out_of_reach_is_put_into_its_direction():
    side = torch.tensor([0.08, -0.08, 0.08, -0.08])
    wanted = torch.stack([torch.full_like(side, 0.15), side, torch.full_like(side, -0.50)], -1)[None]
    q = joint_angles(wanted)
    reached = feet_from_joints(q)
    torch.testing.assert_close(reached[..., 1], wanted[..., 1])
    torch.testing.assert_close(reached[..., 0] / reached[..., 2], wanted[..., 0] / wanted[..., 2])
    torch.testing.assert_close(q[:, 2::3], torch.full((1, 4), -0.5), msg="stretched as far as the knees go")


def test_a_foot_out_of_reach_gives_finite_angles():
    feet = torch.tensor([[0.0, 0.08, -2.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.08, 0.5]])[None]
    assert joint_angles(feet).isfinite().all()
