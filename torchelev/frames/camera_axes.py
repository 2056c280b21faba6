"""The three conventions for a camera's axes, and changes between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchelev.errors import require
from torchelev.frames.arrays import assemble, to_floats

if TYPE_CHECKING:
    from jaxtyping import Float

#: Rotations R_forward_camera (3, 3): from these axes to x forward, y left, z up.
CAMERA_AXES = {
    "forward": np.eye(3),
    "optical": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "opengl": np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]),
}
_R_WANTED_GIVEN = {(g, w): (CAMERA_AXES[w].T @ CAMERA_AXES[g]).tolist() for g in CAMERA_AXES for w in CAMERA_AXES}


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


def turn(xyz: Sequence[Tensor], given: str, wanted: str) -> list[Tensor]:
    """Return x, y and z of points in other camera axes. Each is one of the given ones or its opposite, exactly."""
    rows = _R_WANTED_GIVEN[given, wanted]
    return [next(c if r > 0 else -c for r, c in zip(row, xyz, strict=True) if r) for row in rows]


def require_axes(name: str, axes: str) -> str:
    """Return the name of camera axes; ValueError if there are none of this name."""
    rule, hint = f"must be one of {', '.join(CAMERA_AXES)}", "give the axes of the camera's pose"
    require(axes in CAMERA_AXES, name, rule, repr(axes), hint)
    return axes
