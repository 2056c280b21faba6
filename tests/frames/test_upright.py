"""What `upright=True` notices: quaternions in the wrong order."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchelev.frames import transform, transform_xyzw

WALKING = st.tuples(st.floats(-3.1, 3.1), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4))


@given(WALKING)
def test_lets_walking_robots_pass(angles):
    quat = Rotation.from_euler("ZYX", angles).as_quat()
    plain = transform_xyzw(np.zeros(3), quat)
    assert torch.equal(transform_xyzw(np.zeros(3), quat, upright=True), plain)
    assert torch.equal(transform(np.zeros(3), np.roll(quat, 1), upright=True), plain)


def test_the_limit_is_60_degrees():
    tilted = Rotation.from_euler("X", [[59.0], [61.0]], degrees=True).as_quat()
    transform_xyzw(np.zeros(3), tilted[0], upright=True)
    with pytest.raises(ValueError, match="a tilt of 61 degrees"):
        transform_xyzw(np.zeros(3), tilted[1], upright=True)


@given(st.floats(-1.2, 1.2), st.floats(-0.3, 0.3))
def test_names_the_probable_order(yaw, pitch):
    quat_xyzw = Rotation.from_euler("ZYX", [yaw, pitch, 0]).as_quat()
    with pytest.raises(ValueError, match="quat_xyzw: .* probably w, x, y, z: use transform$"):
        transform_xyzw(np.zeros(3), np.roll(quat_xyzw, 1), upright=True)


def test_names_the_probable_order_of_x_y_z_w():
    yaws = Rotation.from_euler("Z", [[1.5], [-1.4]]).as_quat()
    with pytest.raises(ValueError, match="quat_wxyz: .* probably x, y, z, w: use transform_xyzw"):
        transform(np.zeros((2, 3)), yaws, upright=True)


def test_gives_no_order_that_does_not_help():
    hanging = Rotation.from_euler("X", np.pi).as_quat()
    optical = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]).as_quat()
    for quat in (np.roll(hanging, 1), np.roll(optical, 1)):
        with pytest.raises(ValueError, match="tilt of (180|90) degrees.*or leave out upright"):
            transform(np.zeros(3), quat, upright=True)
        transform(np.zeros(3), quat)


def test_one_robot_of_many_is_enough():
    quats = np.tile([1.0, 0, 0, 0], (5, 1))
    quats[3] = [0, 1, 0, 0]
    with pytest.raises(ValueError, match="a tilt of 180 degrees"):
        transform(np.zeros((5, 3)), quats, upright=True)


def test_no_robots():
    assert transform(np.zeros((0, 3)), np.zeros((0, 4)), upright=True).shape == (0, 4, 4)
