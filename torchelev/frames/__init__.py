"""Construct poses from quaternions of either order, rotation matrices and camera poses. All other code takes 4 x 4.

All constructors take tensors, NumPy arrays and lists, and keep float64.

=====================================  ============  =========================================
from                                   quaternions   cameras
=====================================  ============  =========================================
MuJoCo, mjlab                          w, x, y, z    "opengl" (`cam_xmat`, `cam_quat`)
Isaac Lab 2                            w, x, y, z    `quat_w_ros`: "optical", `quat_w_opengl`:
                                                     "opengl", `quat_w_world`: "forward"
Isaac Lab 3                            x, y, z, w    as Isaac Lab 2
Isaac Gym (legged_gym), ROS, SciPy     x, y, z, w    ROS: "optical" (`*_optical_frame`)
=====================================  ============  =========================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.lazy_names import import_later

if TYPE_CHECKING:
    from torchelev.frames.camera_axes import change_axes
    from torchelev.frames.constructors import transform, transform_matrix, transform_xyzw
    from torchelev.frames.motion import deskew, interpolate_poses

__all__ = ["change_axes", "deskew", "interpolate_poses", "transform", "transform_matrix", "transform_xyzw"]

# Imported when first asked for: `quaternions` need no PyTorch.
_LATER = {
    "change_axes": "torchelev.frames.camera_axes",
    "deskew": "torchelev.frames.motion",
    "interpolate_poses": "torchelev.frames.motion",
    "transform": "torchelev.frames.constructors",
    "transform_matrix": "torchelev.frames.constructors",
    "transform_xyzw": "torchelev.frames.constructors",
}
__getattr__, __dir__ = import_later(__name__, _LATER)
