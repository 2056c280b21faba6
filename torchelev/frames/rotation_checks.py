"""Checks of rotations that lie on a CPU."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchelev.errors import require

_TOLERANCE = 1e-3  # of a quaternion's norm, and of a matrix's products
_MAX_TILT = 60.0  # [deg] between up and the z axis of an upright frame
_OTHER_ORDER = {"quat_wxyz": "x, y, z, w: use transform_xyzw", "quat_xyzw": "w, x, y, z: use transform"}
_XY = {"quat_wxyz": slice(1, 3), "quat_xyzw": slice(0, 2)}  # the places of x and y, which determine the tilt


def require_unit(name: str, quat: Tensor) -> None:
    """Raise ValueError unless all quaternions (..., 4) have norm 1."""
    norm = torch.linalg.vector_norm(quat.detach().double(), dim=-1).flatten()
    worst = float(norm[(norm - 1).abs().argmax()]) if len(norm) else 1.0
    require(abs(worst - 1) < _TOLERANCE, name, "must have norm 1", f"{worst:.6g}", "divide it by its norm")


def require_upright(name: str, quat: Tensor) -> None:
    """Raise ValueError unless all quaternions (..., 4) leave the z axis up; its hint names another order that would."""
    tilts = {order: _max_tilt(quat[..., xy]) for order, xy in _XY.items()}
    tilt = tilts.pop(name)
    hint = "give the pose of a frame whose z axis points up, or leave out upright"
    if max(tilts.values()) <= _MAX_TILT:
        hint = f"read in the other order it points up, so the order is probably {_OTHER_ORDER[name]}"
    require(tilt <= _MAX_TILT, name, "must leave the z axis pointing up", f"a tilt of {tilt:.0f} degrees", hint)


def require_rotations(rotation: Tensor) -> None:
    """Raise ValueError unless all matrices (..., 3, 3) are rotations."""
    R = rotation.detach().double()
    error = (R.mT @ R - torch.eye(3, dtype=torch.float64)).abs().amax((-2, -1))
    wrong = R[~((error < _TOLERANCE) & (torch.linalg.det(R) > 0))]
    rule, hint = "must be orthonormal with determinant 1", "give R_a_b, whose columns are the axes of frame b"
    require(not len(wrong), "rotation", rule, wrong[:1].tolist(), hint)


def _max_tilt(xy: Tensor) -> float:
    """Return the largest angle [deg] between z axes and up, from x and y (..., 2) of quaternions."""
    cosine = 1 - 2 * xy.detach().double().square().sum(-1)
    return math.degrees(math.acos(cosine.min().clamp(-1, 1))) if cosine.numel() else 0.0
