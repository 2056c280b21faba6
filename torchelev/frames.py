"""Poses from positions and quaternions, as simulators give them. Everywhere else a pose is a 4 x 4 matrix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchelev.errors import require

if TYPE_CHECKING:
    from jaxtyping import Float


def transform(
    position: Float[Tensor, "B 3"] | ArrayLike, quat_wxyz: Float[Tensor, "B 4"] | ArrayLike
) -> Float[Tensor, "B 4 4"]:
    """Return the pose T_a_b of frame b in frame a, which takes b-frame coordinates to frame a.

    Args:
        position: (..., 3) origin of frame b in frame a [m]; tensor, NumPy array or list.
        quat_wxyz: (..., 4) rotation of frame b in frame a, a unit quaternion (w, x, y, z).

    Returns:
        (..., 4, 4), on the device of the tensors. Of arrays a CPU tensor of their precision, of lists and integers one
        of float64.

    Raises:
        ValueError: if the shapes do not fit, the values are not numbers or, on the CPU, a quaternion is not normalised.
    """
    position, quat_wxyz = _to_floats("position", position), _to_floats("quat_wxyz", quat_wxyz)
    actual = f"{tuple(position.shape)} and {tuple(quat_wxyz.shape)}"
    fits = position.shape[-1:] == (3,) and quat_wxyz.shape == (*position.shape[:-1], 4)
    require(fits, "position, quat_wxyz", "must be (..., 3) and (..., 4)", actual, "give one quaternion per position")
    if type(quat_wxyz) is Tensor and quat_wxyz.device.type == "cpu" and not torch.compiler.is_compiling():
        norm = torch.linalg.vector_norm(quat_wxyz.double(), dim=-1)
        worst = float(norm.flatten()[(norm - 1).abs().argmax()]) if norm.numel() else 1.0
        require(abs(worst - 1) < 1e-3, "quat_wxyz", "must have norm 1", f"{worst:.6g}", "divide it by its norm")
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), position[..., 0]],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), position[..., 1]],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), position[..., 2]],
        [torch.zeros_like(w), torch.zeros_like(w), torch.zeros_like(w), torch.ones_like(w)],
    ]
    return torch.stack([torch.stack(torch.broadcast_tensors(*row), -1) for row in rows], -2)


def _to_floats(name: str, values: Tensor | ArrayLike) -> Tensor:
    """Return a tensor as it is, and anything else as a new floating-point tensor."""
    if isinstance(values, Tensor):
        return values
    array = np.array(values)
    require(array.dtype.kind in "fiu", name, "must be numbers", array.dtype, "give a tensor or a NumPy array")
    return torch.from_numpy(array if array.dtype.kind == "f" else array.astype(np.float64))
