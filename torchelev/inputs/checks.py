"""Checks of arguments, made before anything changes.

Shapes, dtypes and devices are always checked. Checks that read values, such as those of poses and ids, make the host
wait for the device. They are made for CPU tensors, and elsewhere only if the caller asks for them with `always`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import message, require
from torchelev.ops.transforms import is_readable

FARTHEST = 1e9  # [m] limit of coordinates; beyond it float64 misses cells
FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_FEW = 8  # poses, up to which Python's numbers are faster than NumPy's
_POSE_DTYPES = (torch.float32, torch.float64)
Config = TypeVar("Config")


def require_tensor(name: str, value: object) -> Tensor:
    """Return the value; TypeError unless it is a tensor."""
    actual, hint = type(value).__name__, "make it one with torch.as_tensor"
    require(isinstance(value, Tensor), name, "must be a torch.Tensor", actual, hint, TypeError)
    assert isinstance(value, Tensor)
    return value


def check_tensor(
    name: str,
    value: object,
    device: torch.device,
    dtypes: tuple[torch.dtype, ...],
    convert: str | None = None,
) -> Tensor:
    """Return a tensor on this device of one of these dtypes; `convert` is the hint for any other dtype."""
    if isinstance(value, Tensor) and value.dtype in dtypes and _is_same(value.device, device):
        return value  # early: composing the messages below takes as long as all other checks
    value = require_tensor(name, value)
    kinds = ", ".join(str(d).removeprefix("torch.") for d in dtypes)
    convert = convert or f"convert it with .to({torch.float32 if torch.float32 in dtypes else dtypes[0]})"
    require(value.dtype in dtypes, name, f"must be {kinds}", value.dtype, convert, TypeError)
    actual = f"{tuple(value.shape)} on {value.device}"
    require(_is_same(value.device, device), name, f"must be on {device}", actual, "move it with .to(emap.device)")
    return value


def _is_same(a: torch.device, b: torch.device) -> bool:
    return a == b or (a.type, a.index or 0) == (b.type, b.index or 0)


def given_or_default(kind: type[Config], cfg: object) -> Config:
    """Return a config of this kind: the given one, or the defaults for None."""
    cfg = kind() if cfg is None else cfg
    hint = f"give {kind.__name__}(...)"
    require(isinstance(cfg, kind), "cfg", f"must be a {kind.__name__}", repr(cfg), hint, TypeError)
    assert isinstance(cfg, kind)
    return cfg


# Poses ----------------------------------------------------------------------------------------------------------------


def check_pose(name: str, pose: object, shape: tuple[int, ...], device: torch.device, always: bool) -> Tensor:
    """Return rigid transforms (..., 4, 4) of this shape."""
    value = check_tensor(name, pose, device, _POSE_DTYPES)
    if value.shape != shape:
        hint = "give one 4 x 4 matrix for each"
        raise ValueError(message(name, f"expected {shape} on {device}", tuple(value.shape), hint))
    if is_readable(value, always) and not _are_rigid(value):
        _require_rigid(name, value)
    return value


def _are_rigid(pose: Tensor) -> bool:
    """Return quickly whether all matrices are rigid; if not, `_require_rigid` decides and words the error."""
    matrices = pose.reshape(-1, 16)
    if len(matrices) <= _FEW:
        return all(map(_is_rigid, matrices.tolist()))
    with np.errstate(all="ignore"):  # of what is not finite
        return bool(np.all(_is_rigid(matrices.detach().cpu().double().T.contiguous().numpy())))


def _is_rigid(matrix: Any) -> Any:
    """Return whether a matrix, its 16 entries row by row, is rigid. Entries may be arrays: one matrix per element."""
    a, b, c, x, d, e, f, y, g, h, i, z, *last = matrix
    good = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0
    for length in (a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i):
        good &= abs(length - 1) < 1e-3
    for product in (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i):
        good &= abs(product) < 1e-3
    for value, exact in zip(last, (0, 0, 0, 1), strict=True):
        good &= value == exact
    for coordinate in (x, y, z):
        good &= abs(coordinate) <= FARTHEST
    return good


def _require_rigid(name: str, pose: Tensor) -> None:
    """Refuse matrices that are not finite and rigid, or whose position is out of range."""
    # In NumPy, whose calls cost a fifth of torch's: for one robot they dominate the checks.
    matrix = pose.detach().cpu().double().numpy()
    matrix = matrix if pose.ndim > 2 else matrix[None]

    def refuse(bad: np.ndarray, rule: str, actual: Callable[[], str], hint: str) -> None:
        if bad.any():
            raise ValueError(message(name, rule, actual() + name_environments(bad), hint))

    hint = "where the pose is unknown, give any rigid one, and NaN points if they should be ignored"
    refuse(~np.isfinite(matrix), "must be finite", lambda: "NaN or inf", hint)
    hint = "use torchelev.frames.transform(position, quat_wxyz)"
    rotation, distance, last_row = matrix[..., :3, :3], np.abs(matrix[..., :3, 3]), matrix[..., 3, :]
    error = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3))
    refuse(error >= 1e-3, "must be rigid (R R^T = 1)", lambda: f"an error of {error.max():.3g}", hint)
    refuse(np.linalg.det(rotation) <= 0, "must not mirror", lambda: "determinant -1", hint)
    bad = np.abs(last_row - (0, 0, 0, 1)) > 1e-6  # an inverse may round
    if bad.any() and (matrix[..., 3] == (0, 0, 0, 1)).all():
        hint = "transpose it: the position is the last column"
    refuse(bad, "must have the last row 0 0 0 1", lambda: " ".join(f"{x:g}" for x in last_row[bad.any(-1)][0]), hint)
    hint = "check its units and source"
    refuse(distance > FARTHEST, f"must lie within {FARTHEST:g} m", lambda: f"{distance.max():.3g} m", hint)


def require_covariance(name: str, value: Tensor) -> None:
    """Refuse matrices (B, ..., 6, 6) that are not finite, symmetric and positive semidefinite."""
    matrix = value.detach().cpu().double().numpy()
    scale = np.abs(matrix).max(initial=0.0)
    bad = ~np.isfinite(matrix)
    hint = "where the pose's uncertainty is unknown, leave it out"
    require(not bad.any(), name, "must be finite", "NaN or inf" + name_environments(bad), hint)
    bad = np.abs(matrix - matrix.swapaxes(-1, -2)) > 1e-4 * scale
    hint = "give the covariance of x, y, z and the rotations about the map's axes"
    require(not bad.any(), name, "must be symmetric", "another" + name_environments(bad), hint)
    bad = np.linalg.eigvalsh(matrix) < -1e-4 * scale
    require(not bad.any(), name, "must have no negative eigenvalue", "one" + name_environments(bad), hint)


def name_environments(bad: np.ndarray) -> str:
    """Return " in environment 0, 2" for the rows (B, ...) that hold a bad value, and "" if there is one row only."""
    which = np.flatnonzero(bad.reshape(len(bad), -1).any(1))
    more = f" and {len(which) - 3} more" if len(which) > 3 else ""
    return f" in environment {', '.join(map(str, which[:3]))}{more}" if len(bad) > 1 else ""


# Environments ---------------------------------------------------------------------------------------------------------


def require_indices(
    name: str, value: Tensor, count: int, hint: str = "leave out the others", always: bool = False
) -> None:
    """Refuse indices outside [0, count)."""
    if is_readable(value, always) and value.numel():
        low, high = int(value.min()), int(value.max())
        require(low >= 0 and high < count, name, f"must lie in [0, {count})", f"{low}..{high}", hint)


def check_env_ids(env_ids: object, num_envs: int, device: torch.device, always: bool) -> Tensor:
    """Return ids (K,) int64, each in range and none twice."""
    is_mask = isinstance(env_ids, Tensor) and env_ids.dtype == torch.bool
    convert = "pass it as mask=" if is_mask else "convert it with .to(torch.int64)"
    value = check_tensor("env_ids", env_ids, device, (torch.int64,), convert)
    require(value.ndim == 1, "env_ids", "must be 1-D", tuple(value.shape), "flatten it, or pass mask=")
    require_indices("env_ids", value, num_envs, always=always)
    if is_readable(value, always) and value.numel():
        unique = value.unique().numel() == value.numel()
        require(unique, "env_ids", "must not repeat", value.tolist(), "use torch.unique or pass mask=")
    return value


def check_mask(name: str, mask: object, num_envs: int, device: torch.device) -> Tensor:
    """Return a mask (B,) of environments."""
    value = check_tensor(name, mask, device, (torch.bool,))
    fits = tuple(value.shape) == (num_envs,)
    require(fits, name, f"expected ({num_envs},)", tuple(value.shape), "give one bool per environment")
    return value


# Places ---------------------------------------------------------------------------------------------------------------


def check_xy(name: str, xy: object, num_envs: int, device: torch.device) -> Tensor:
    """Return points (B, M, 2)."""
    value = check_tensor(name, xy, device, FLOATS)
    fits = value.ndim == 3 and value.shape[0] == num_envs and value.shape[2] == 2
    require(fits, name, f"expected ({num_envs}, M, 2)", tuple(value.shape), "give points for each environment")
    return value


def check_center(center: object, num_envs: int, device: torch.device, always: bool) -> Tensor:
    """Return a finite place (B, 2) of each environment."""
    value = check_tensor("center", center, device, FLOATS)
    fits = tuple(value.shape) == (num_envs, 2)
    require(fits, "center", f"expected ({num_envs}, 2)", tuple(value.shape), "give x and y of each environment")
    if is_readable(value, always):
        require(bool(torch.isfinite(value).all()), "center", "must be finite", "NaN or inf", "give x and y in metres")
    return value


def check_feet(feet: object, num_envs: int, device: torch.device, always: bool) -> Tensor:
    """Return finite ground points (B, K, 3), at least one per environment."""
    value = check_tensor("feet", feet, device, FLOATS)
    fits = value.ndim == 3 and value.shape[0] == num_envs and value.shape[1] >= 1 and value.shape[2] == 3
    require(fits, "feet", f"expected ({num_envs}, K, 3) with K >= 1", tuple(value.shape), "give ground points")
    if is_readable(value, always):
        require(bool(torch.isfinite(value).all()), "feet", "must be finite", "NaN or inf", "leave those feet out")
    return value
