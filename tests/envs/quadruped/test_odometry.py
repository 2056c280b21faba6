"""Leg odometry: exact while feet hold, wrong as they slip."""

import math

import torch

from envs.quadruped.config import OdometryConfig
from envs.quadruped.odometry import LegOdometry

EXACT = OdometryConfig(velocity_noise=0.0, scale_error=0.0, yaw_drift=0.0, height_drift=0.0)
FORCES = torch.tensor([[30.0, 0.0, 0.0, 30.0]])
VELOCITY = torch.tensor([[0.5, 0.1, 0.2]])


def walk(odometry, slip, forces=FORCES, steps=100):
    feet = torch.zeros(1, 4, 3)
    feet[..., 0] = slip
    for _ in range(steps):
        odometry.step(VELOCITY, feet, forces, 0.02)
    return odometry.estimate(torch.eye(4)[None])[0, :3, 3]


def test_the_estimate_is_exact_while_feet_hold():
    torch.testing.assert_close(walk(LegOdometry(EXACT, 1, "cpu"), 0.0), torch.zeros(3))


def test_slip_is_taken_for_motion_of_the_base():
    # Feet that slip forward at 0.1 m/s for 2 s make the base seem 0.2 m behind.
    torch.testing.assert_close(walk(LegOdometry(EXACT, 1, "cpu"), 0.1), torch.tensor([-0.2, 0.0, 0.0]))


def test_feet_in_the_air_do_not_count():
    feet = torch.zeros(1, 4, 3)
    feet[:, 1:3] = 1.0
    odometry = LegOdometry(EXACT, 1, "cpu")
    odometry.step(VELOCITY, feet, FORCES, 0.02)
    torch.testing.assert_close(odometry.error, torch.zeros(1, 3))


def test_without_a_foot_on_the_ground_the_last_velocity_holds():
    odometry = LegOdometry(EXACT, 1, "cpu")
    odometry.step(VELOCITY, torch.zeros(1, 4, 3), FORCES, 0.02)
    odometry.step(2 * VELOCITY, torch.zeros(1, 4, 3), torch.zeros(1, 4), 0.02)
    torch.testing.assert_close(odometry.velocity, VELOCITY)
    torch.testing.assert_close(odometry.error, -0.02 * VELOCITY)


def test_heading_and_height_drift_as_random_walks():
    cfg = OdometryConfig(velocity_noise=0.0, scale_error=0.0, yaw_drift=0.1, height_drift=0.2)
    odometry = LegOdometry(cfg, 4000, "cpu")
    still = torch.zeros(4000, 3)
    for _ in range(50):
        odometry.step(still, torch.zeros(4000, 4, 3), torch.full((4000, 4), 30.0), 0.02)
    assert abs(float(odometry.yaw_error.std()) - 0.1) < 0.01
    assert abs(float(odometry.error[:, 2].std()) - 0.2) < 0.02


def test_the_estimated_pose_turns_about_the_vertical():
    odometry = LegOdometry(EXACT, 1, "cpu")
    odometry.yaw_error.fill_(math.pi / 2)
    T = odometry.estimate(torch.eye(4)[None])[0]
    torch.testing.assert_close(T[:3, 0], torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)
    torch.testing.assert_close(T[:3, 2], torch.tensor([0.0, 0.0, 1.0]))


def test_reset_forgets_in_the_chosen_environments_only():
    odometry = LegOdometry(OdometryConfig(), 2, "cpu")
    odometry.error.fill_(1.0)
    odometry.reset(torch.tensor([True, False]))
    assert odometry.error.tolist() == [[0.0] * 3, [1.0] * 3]
