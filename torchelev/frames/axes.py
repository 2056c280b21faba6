"""The three conventions for a camera's axes. Works on tensors and arrays alike, and needs no PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from torchelev.errors import require

Values = TypeVar("Values", bound=Any)

#: Rotations R_forward_camera (3, 3): from these axes to x forward, y left, z up.
CAMERA_AXES = {
    "forward": np.eye(3),
    "optical": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "opengl": np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]),
}
_R_WANTED_GIVEN = {(g, w): (CAMERA_AXES[w].T @ CAMERA_AXES[g]).tolist() for g in CAMERA_AXES for w in CAMERA_AXES}


def turn(xyz: Sequence[Values], given: str, wanted: str) -> list[Values]:
    """Return x, y and z of points in other camera axes. Each is one of the given ones or its opposite, exactly."""
    rows = _R_WANTED_GIVEN[given, wanted]
    return [next(c if r > 0 else -c for r, c in zip(row, xyz, strict=True) if r) for row in rows]


def require_axes(name: str, axes: str) -> str:
    """Return the name of camera axes; ValueError if there are none of this name."""
    rule, hint = f"must be one of {', '.join(CAMERA_AXES)}", "give the axes of the camera's pose"
    require(axes in CAMERA_AXES, name, rule, repr(axes), hint)
    return axes
