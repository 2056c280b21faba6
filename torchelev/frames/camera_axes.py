"""Changes between the three conventions for a camera's axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchelev.errors import require
from torchelev.frames.arrays import assemble, to_floats
from torchelev.frames.axes import require_axes, turn

if TYPE_CHECKING:
    from jaxtyping import Float


def change_axes(T_a_camera: Float[Tensor, "*B 4 4"] | ArrayLike, given: str, wanted: str) -> Float[Tensor, "*B 4 4"]:
    """Return the pose of the same camera with other axes.

    "optical": x right, y down, z forward; ROS, OpenCV, RealSense, and Isaac Lab's `quat_w_ros`.
    "opengl": x right, y up, z backward; the cameras of MuJoCo and Isaac Sim, and Isaac Lab's `quat_w_opengl`.
    "forward": x forward, y left, z up; a robot's base, ROS' `camera_link`, and Isaac Lab's `quat_w_world`.

    Args:
        T_a_camera: (..., 4, 4) pose of the camera; its position stays.
        given: axes of this pose.
        wanted: axes of the pose to return, which must be those of its points: see `depth_to_points(frame=...)`.

    Returns:
        (..., 4, 4) in the precision and on the device of the pose.

    Raises:
        ValueError: for other names or another shape.
    """
    T = to_floats("T_a_camera", T_a_camera)
    hint = "see torchelev.frames.transform"
    require(T.shape[-2:] == (4, 4), "T_a_camera", "expected (..., 4, 4)", tuple(T.shape), hint)
    axes = turn(T[..., :3, :3].unbind(-1), require_axes("given", given), require_axes("wanted", wanted))
    return assemble(T[..., :3, 3], torch.stack(axes, -1))
