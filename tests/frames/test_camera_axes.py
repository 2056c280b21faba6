"""Camera axes: optical, OpenGL and forward."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchelev import depth_to_points
from torchelev.frames import change_axes, transform_matrix

# What a camera that looks along x, upright, calls forward, left and up.
DIRECTIONS = {
    "forward": {"forward": [1, 0, 0], "left": [0, 1, 0], "up": [0, 0, 1]},
    "optical": {"forward": [0, 0, 1], "left": [-1, 0, 0], "up": [0, -1, 0]},
    "opengl": {"forward": [0, 0, -1], "left": [-1, 0, 0], "up": [0, 1, 0]},
}
PAIRS = [(given, wanted) for given in DIRECTIONS for wanted in DIRECTIONS]


def draw_pose(seed):
    rng = np.random.default_rng(seed)
    return transform_matrix(rng.normal(size=(2, 3)) * 1e5, Rotation.random(2, rng).as_matrix())


@pytest.mark.parametrize("given, wanted", PAIRS)
def test_directions_stay_in_the_map(given, wanted):
    T_given = draw_pose(0)
    T_wanted = change_axes(T_given, given, wanted)
    assert T_wanted.dtype == torch.float64 and torch.equal(T_wanted[:, :, 3], T_given[:, :, 3])
    for name, direction in DIRECTIONS[given].items():
        in_map = T_given[:, :3, :3] @ torch.tensor(direction).double()
        assert torch.equal(T_wanted[:, :3, :3] @ torch.tensor(DIRECTIONS[wanted][name]).double(), in_map), name


def test_mujoco_to_optical_turns_half_about_x():
    T = draw_pose(1)
    torch.testing.assert_close(
        change_axes(T, "opengl", "optical"), T @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
    )


@pytest.mark.parametrize("given, wanted", PAIRS)
def test_points_of_depth_images_agree(given, wanted):
    depth = torch.from_numpy(np.random.default_rng(2).uniform(0.5, 5, (2, 4, 6)))
    K = torch.tensor([[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]]).double()

    def in_map(axes):
        T = change_axes(draw_pose(3), given, axes)
        return depth_to_points(depth, K, frame=axes) @ T[:, :3, :3].mT

    torch.testing.assert_close(in_map(wanted), in_map(given))


def test_takes_arrays_and_float32():
    T = change_axes(np.eye(4, dtype=np.float32), "forward", "optical")
    assert T.dtype == torch.float32
    assert T[:3, 2].tolist() == [1, 0, 0]


def test_compiles():
    T = draw_pose(4)
    compiled = torch.compile(change_axes, backend="eager", fullgraph=True)
    assert torch.equal(compiled(T, "opengl", "forward"), change_axes(T, "opengl", "forward"))


@pytest.mark.parametrize(
    "T, given, wanted, named",
    [
        (torch.eye(4), "ros", "optical", "given: must be one of forward, optical, opengl, got 'ros'"),
        (torch.eye(4), "optical", "usd", "wanted"),
        (torch.eye(3), "optical", "opengl", "T_a_camera"),
    ],
)
def test_refuses(T, given, wanted, named):
    with pytest.raises(ValueError, match=named):
        change_axes(T, given, wanted)
