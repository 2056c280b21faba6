"""What the map refuses, before anything changed.

Shapes, dtypes and devices are always checked. Checks that read values (rigid poses, a tensor `dt`, ids) would make the
host wait for the device, so they run for CPU tensors and, on request, for others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.ops.transforms import is_transforming

FARTHEST = 1e9  # [m] farther, a float64 counts cells wrongly
FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
FULL_PRECISION = FLOATS[2:]
Config = TypeVar("Config")


def readable(value: Tensor, always: bool = False) -> bool:
    """Tell whether a value may be read now: not while compiling or transforming, nor from tensors without data."""
    plain = type(value) in (Tensor, torch.nn.Parameter) and not is_transforming()
    return plain and not torch.compiler.is_compiling() and (always or value.device.type == "cpu")


def require_tensor(name: str, value: object) -> Tensor:
    """Return the value, and refuse what is no tensor."""
    actual, hint = type(value).__name__, "make it one with torch.tensor"
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
    """Refuse what is no tensor, lies elsewhere, or has another dtype, for which `convert` is the hint."""
    if isinstance(value, Tensor) and value.dtype in dtypes and _same(value.device, device):
        return value  # before a message is made, which takes as long as all the rest
    value = require_tensor(name, value)
    kinds = ", ".join(str(d).removeprefix("torch.") for d in dtypes)
    convert = convert or f"convert it with .to({torch.float32 if torch.float32 in dtypes else dtypes[0]})"
    require(value.dtype in dtypes, name, f"must be {kinds}", value.dtype, convert, TypeError)
    actual = f"{tuple(value.shape)} on {value.device}"
    require(_same(value.device, device), name, f"must be on {device}", actual, "move it with .to(emap.device)")
    return value


def _same(one: torch.device, other: torch.device) -> bool:
    return (one.type, one.index or 0) == (other.type, other.index or 0)


def given_or_default(kind: type[Config], cfg: object) -> Config:
    """Return what was given for a config of this kind; the defaults for None."""
    cfg = kind() if cfg is None else cfg
    require(isinstance(cfg, kind), "cfg", f"must be a {kind.__name__}", repr(cfg), "build one", TypeError)
    assert isinstance(cfg, kind)
    return cfg


def check_points(points: object, num_envs: int, device: torch.device) -> Tensor:
    """Return the points as (B, S, N, 3)."""
    value = check_tensor("points", points, device, FLOATS)
    fits = value.ndim in (3, 4) and value.shape[0] == num_envs and value.shape[-1] == 3
    rule = f"expected (B, N, 3) or (B, S, N, 3) with B = {num_envs} on {device}"
    hint = "give one cloud per environment, padded with NaN"
    if value.ndim in (3, 4) and value.shape[-1] != 3:
        hint = "transpose the last two dimensions" if value.shape[-2] == 3 else "keep x, y and z alone: points[..., :3]"
    require(fits, "points", rule, f"{tuple(value.shape)} on {value.device}", hint)
    value = value if value.ndim == 4 else value[:, None]
    require(value.shape[1] > 0, "points", "must have at least one sensor", tuple(value.shape), "give S >= 1")
    return value


def check_pose(name: str, pose: object, shape: tuple[int, ...], device: torch.device, always: bool) -> Tensor:
    """Return a rigid transform of this shape, which may lack the sensor dimension."""
    value = check_tensor(name, pose, device, FULL_PRECISION)
    rule = f"expected {shape} on {device}"
    require(tuple(value.shape) == shape, name, rule, tuple(value.shape), "give one 4 x 4 matrix for each")
    if readable(value, always):
        _check_rigid(name, value)
    return value


def _check_rigid(name: str, pose: Tensor) -> None:
    # In NumPy, whose calls cost a fifth of torch's: for one robot they are what a check costs. What an error says is
    # made when there is one.
    matrix = pose.detach().cpu().double().numpy()
    matrix = matrix if pose.ndim > 2 else matrix[None]

    def refuse(bad: np.ndarray, rule: str, actual: Callable[[], str], hint: str) -> None:
        if bad.any():
            require(False, name, rule, actual() + _environments(bad), hint)

    hint = "give any rigid pose where there is none, with points of NaN if it is to take none in"
    refuse(~np.isfinite(matrix), "must be finite", lambda: "NaN or inf", hint)
    hint = "use torchelev.frames.transform(position, quat_wxyz)"
    rotation, distance, last = matrix[..., :3, :3], np.abs(matrix[..., :3, 3]), matrix[..., 3, :]
    error = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3))
    refuse(error >= 1e-3, "must be rigid (R R^T = 1)", lambda: f"an error of {error.max():.3g}", hint)
    refuse(np.linalg.det(rotation) <= 0, "must not mirror", lambda: "determinant -1", hint)
    other = np.abs(last - (0, 0, 0, 1)) > 1e-6  # an inverse may round
    if other.any() and (matrix[..., 3] == (0, 0, 0, 1)).all():
        hint = "transpose it: the position is the last column"
    refuse(other, "must have the last row 0 0 0 1", lambda: " ".join(f"{x:g}" for x in last[other.any(-1)][0]), hint)
    hint = "check its units and source"
    refuse(distance > FARTHEST, f"must lie within {FARTHEST:g} m", lambda: f"{distance.max():.3g} m", hint)


def _environments(bad: np.ndarray) -> str:
    """Name the environments, first of the dimensions, in which something is bad; nothing where there is but one."""
    which = np.flatnonzero(bad.reshape(len(bad), -1).any(1))
    more = f" and {len(which) - 3} more" if len(which) > 3 else ""
    return f" in environment {', '.join(map(str, which[:3]))}{more}" if len(bad) > 1 else ""


def require_full_precision(dtype: torch.dtype) -> None:
    """Refuse to fuse into a map of half precision, which holds neither a cell's number nor a millimetre's variance."""
    hint = "call .float() on it; points may be of half precision"
    require(dtype in FULL_PRECISION, "map", "must be float32 or float64 to take in points", dtype, hint, TypeError)


def check_dt(dt: object, num_envs: int, device: torch.device, dtype: torch.dtype, always: bool) -> Tensor:
    """Return dt as (B,) [s]."""
    hint = "give the seconds since the last update, or 0.0 for a further sensor of the same instant"
    require(dt is not None, "dt", "is required", "none", hint, TypeError)
    if isinstance(dt, Tensor):
        value = check_tensor("dt", dt, device, FLOATS)
        fits = tuple(value.shape) in ((), (num_envs,))
        require(fits, "dt", f"expected a number or ({num_envs},)", tuple(value.shape), "give one dt per environment")
        if readable(value, always):
            given = np.atleast_1d(value.detach().double().cpu().numpy())
            bad = ~((given >= 0) & (given < math.inf))
            hint = "give seconds since the last update"
            actual = f"{given[bad][0]:g}{_environments(bad)}" if bad.any() else ""
            require(not bad.any(), "dt", "must be finite and not negative", actual, hint)
        return value.to(dtype).expand(num_envs)
    number = isinstance(dt, (float, Real)) and not isinstance(dt, bool)  # a float is told ten times as fast
    require(number, "dt", "must be a number or a tensor", type(dt).__name__, "give seconds", TypeError)
    seconds = float(dt)  # type: ignore[arg-type]
    good = math.isfinite(seconds) and seconds >= 0
    require(good, "dt", "must be finite and not negative", dt, "give seconds since the last update")
    return torch.full((num_envs,), seconds, device=device, dtype=dtype)


def require_indices(
    name: str, value: Tensor, count: int, hint: str = "leave out the others", always: bool = False
) -> None:
    """Refuse numbers outside of [0, count), where they may be read."""
    if readable(value, always) and value.numel():
        low, high = int(value.min()), int(value.max())
        require(low >= 0 and high < count, name, f"must lie in [0, {count})", f"{low}..{high}", hint)


def check_env_ids(env_ids: object, num_envs: int, device: torch.device, always: bool) -> Tensor:
    """Return ids (K,) int64: each in range, none twice."""
    is_mask = isinstance(env_ids, Tensor) and env_ids.dtype == torch.bool
    convert = "pass it as mask=" if is_mask else "convert it with .to(torch.int64)"
    value = check_tensor("env_ids", env_ids, device, (torch.int64,), convert)
    require(value.ndim == 1, "env_ids", "must be 1-D", tuple(value.shape), "flatten it, or pass mask=")
    require_indices("env_ids", value, num_envs, always=always)
    if readable(value, always) and value.numel():
        unique = value.unique().numel() == value.numel()
        require(unique, "env_ids", "must not repeat", value.tolist(), "use torch.unique or pass mask=")
    return value


def check_xy(name: str, xy: object, num_envs: int, device: torch.device) -> Tensor:
    """Return points (B, M, 2) of each environment."""
    value = check_tensor(name, xy, device, FLOATS)
    fits = value.ndim == 3 and value.shape[0] == num_envs and value.shape[2] == 2
    require(fits, name, f"expected ({num_envs}, M, 2)", tuple(value.shape), "give points for each environment")
    return value
