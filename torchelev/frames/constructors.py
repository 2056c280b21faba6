"""Poses from a position and a rotation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchelev.errors import require
from torchelev.frames.arrays import assemble, to_floats
from torchelev.frames.rotation_checks import require_rotations, require_unit, require_upright
from torchelev.ops.transforms import is_readable

if TYPE_CHECKING:
    from jaxtyping import Float


def transform(
    position: Float[Tensor, "*B 3"] | ArrayLike, quat_wxyz: Float[Tensor, "*B 4"] | ArrayLike, *, upright: bool = False
) -> Float[Tensor, "*B 4 4"]:
    """Return the pose T_a_b of frame b in frame a, which takes b-frame coordinates to frame a.

    Args:
        position: (..., 3) origin of frame b in frame a [m]; tensor, NumPy array or list.
        quat_wxyz: (..., 4) rotation of frame b in frame a, a unit quaternion (w, x, y, z).
        upright: refuse a pose whose z axis points more than 60 degrees away from up. Set it for the base of a robot
            that stands: a quaternion in the wrong order is a valid rotation too, and is noticed only by its tilt.

    Returns:
        (..., 4, 4), on the device of the tensors. Of arrays a CPU tensor of their precision, of lists and integers one
        of float64.

    Raises:
        ValueError: if the shapes do not fit, the values are not numbers or, on the CPU, a quaternion is not normalised
            or not upright. Values on a GPU are not checked.
    """
    place, quat = _read("quat_wxyz", position, quat_wxyz, upright)
    w, x, y, z = quat.unbind(-1)
    return _from_quaternion(place, w, x, y, z)


def transform_xyzw(
    position: Float[Tensor, "*B 3"] | ArrayLike, quat_xyzw: Float[Tensor, "*B 4"] | ArrayLike, *, upright: bool = False
) -> Float[Tensor, "*B 4 4"]:
    """Return the pose T_a_b, as `transform` does, from a quaternion (x, y, z, w).

    Args:
        position: (..., 3) origin of frame b in frame a [m]; tensor, NumPy array or list.
        quat_xyzw: (..., 4) rotation of frame b in frame a, a unit quaternion (x, y, z, w).
        upright: see `transform`.

    Returns:
        (..., 4, 4), see `transform`.

    Raises:
        ValueError: see `transform`.
    """
    place, quat = _read("quat_xyzw", position, quat_xyzw, upright)
    x, y, z, w = quat.unbind(-1)
    return _from_quaternion(place, w, x, y, z)


def transform_matrix(
    position: Float[Tensor, "*B 3"] | ArrayLike, rotation: Float[Tensor, "*B 3 3"] | ArrayLike
) -> Float[Tensor, "*B 4 4"]:
    """Return the pose T_a_b, as `transform` does, from a rotation matrix, such as MuJoCo's `data.cam_xmat`.

    Args:
        position: (..., 3) origin of frame b in frame a [m]; tensor, NumPy array or list.
        rotation: (..., 3, 3) R_a_b, or (..., 9), its rows one after another.

    Returns:
        (..., 4, 4), see `transform`.

    Raises:
        ValueError: if the shapes do not fit, the values are not numbers or, on the CPU, a matrix is not a rotation.
    """
    place, R = to_floats("position", position), to_floats("rotation", rotation)
    actual = f"{tuple(place.shape)} and {tuple(R.shape)}"
    R = R.unflatten(-1, (3, 3)) if R.shape[-1:] == (9,) else R
    fits = place.shape[-1:] == (3,) and R.shape == (*place.shape[:-1], 3, 3)
    rule = "must be (..., 3) and (..., 3, 3) or (..., 9)"
    require(fits, "position, rotation", rule, actual, "give one matrix per position")
    if is_readable(R):
        require_rotations(R)
    return assemble(place, R)


def _read(name: str, position: Tensor | ArrayLike, values: Tensor | ArrayLike, upright: bool) -> tuple[Tensor, Tensor]:
    """Return a position and a quaternion as checked tensors."""
    place, quat = to_floats("position", position), to_floats(name, values)
    actual = f"{tuple(place.shape)} and {tuple(quat.shape)}"
    fits = place.shape[-1:] == (3,) and quat.shape == (*place.shape[:-1], 4)
    require(fits, f"position, {name}", "must be (..., 3) and (..., 4)", actual, "give one quaternion per position")
    if is_readable(quat):
        require_unit(name, quat)
        if upright:
            require_upright(name, quat)
    return place, quat


def _from_quaternion(position: Tensor, w: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return assemble(position, torch.stack([torch.stack(row, -1) for row in rows], -2))
