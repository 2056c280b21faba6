"""The inputs of an update, and the checks that they pass before anything changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, cast, overload

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import message, require
from torchelev.inputs import checks
from torchelev.ops.transforms import is_readable, require_reverse_mode

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_Result = TypeVar("_Result")
_ResultOut = TypeVar("_ResultOut", covariant=True)


class Inputs(NamedTuple):
    """Checked inputs of one update of B environments: N points of each of S sensors."""

    points: Float[Tensor, "B S N 3"]  #: [m] sensor frame; NaN or inf where there is no return
    T_map_sensor: Float[Tensor, "B S 4 4"]  #: takes sensor-frame points into the map frame
    T_map_base: Float[Tensor, "B 4 4"] | None  #: pose of the robot; None: unknown, the window stays
    dt: Float[Tensor, "B"]  #: [s] since the environment's last update
    variance: Float[Tensor, "B S N"] | None  #: [m^2] of each point's height; None: the noise model's
    T_base_links: Float[Tensor, "B K 4 4"] | None  #: poses of the links of `sensor.body`; None: it has none
    pose_covariance: Float[Tensor, "B S 6 6"] | None = None  #: of each sensor's pose; None: poses are exact
    moving: Bool[Tensor, "B"] | None = None  #: environments whose height may drift; None: all
    aside: Bool[Tensor, "B S N"] | None = None  #: points of other surfaces than the ground; None: there are none


class TakesInputs(Protocol[_ResultOut]):
    """The signature of `measure`.

    `dt` is required but follows `T_map_base`, which may be left out. Two overloads make type checkers ask for it.
    """

    @overload
    def __call__(
        self,
        points: Tensor,
        T_map_sensor: Tensor,
        T_map_base: Tensor | None,
        dt: float | Tensor,
        *,
        variance: Tensor | None = None,
        T_base_links: Tensor | None = None,
        pose_covariance: Tensor | None = None,
        moving: bool | Tensor | None = None,
    ) -> _ResultOut: ...
    @overload
    def __call__(
        self,
        points: Tensor,
        T_map_sensor: Tensor,
        *,
        dt: float | Tensor,
        variance: Tensor | None = None,
        T_base_links: Tensor | None = None,
        pose_covariance: Tensor | None = None,
        moving: bool | Tensor | None = None,
    ) -> _ResultOut: ...


class TakesFeatures(Protocol):
    """The signature of `update`.

    As `TakesInputs`, with what points bring for channels.
    """

    @overload
    def __call__(
        self,
        points: Tensor,
        T_map_sensor: Tensor,
        T_map_base: Tensor | None,
        dt: float | Tensor,
        *,
        variance: Tensor | None = None,
        T_base_links: Tensor | None = None,
        pose_covariance: Tensor | None = None,
        moving: bool | Tensor | None = None,
        features: Any = None,  # a Mapping, but other arguments come as dicts of tensors
    ) -> None: ...
    @overload
    def __call__(
        self,
        points: Tensor,
        T_map_sensor: Tensor,
        *,
        dt: float | Tensor,
        variance: Tensor | None = None,
        T_base_links: Tensor | None = None,
        pose_covariance: Tensor | None = None,
        moving: bool | Tensor | None = None,
        features: Any = None,  # a Mapping, but other arguments come as dicts of tensors
    ) -> None: ...


def requires_dt(method: Callable[..., _Result]) -> TakesInputs[_Result]:
    """Return the method unchanged, typed such that type checkers require `dt`."""
    return cast(TakesInputs[_Result], method)


def takes_features(method: Callable[..., None]) -> TakesFeatures:
    """Return `update` unchanged, typed such that type checkers require `dt`."""
    return cast(TakesFeatures, method)


def check_inputs(
    points: Any,
    T_map_sensor: Any,
    T_map_base: Any,
    dt: Any,
    variance: Any,
    T_base_links: Any,
    pose_covariance: Any,
    moving: Any,
    num_envs: int,
    device: torch.device,
    dtype: torch.dtype,
    links: tuple[str, ...],
    check_values: bool,
) -> Inputs:
    """Check the arguments of `update` and `measure`, and return them in the shapes that the stages take.

    `device` and `dtype` are the map's, `links` those of its `sensor.body`. `check_values` also reads poses and a tensor
    `dt` that lie on another device than the CPU.
    """
    require_full_precision(dtype)
    require_reverse_mode((points, T_map_sensor, T_map_base, dt, variance, T_base_links, pose_covariance))
    cloud = _check_points(points, num_envs, device)
    B, S = num_envs, cloud.shape[1]  # not the cloud's B, which the compiler may take for variable
    shape = (B, S, 4, 4) if points.ndim == 4 else (B, 4, 4)
    T_map_sensor = checks.check_pose("T_map_sensor", T_map_sensor, shape, device, check_values).view(B, S, 4, 4)
    if T_map_base is not None:
        T_map_base = checks.check_pose("T_map_base", T_map_base, (B, 4, 4), device, check_values)
    dt = _check_dt(dt, B, device, dtype, check_values)
    if variance is not None:
        variance = checks.check_tensor("variance", variance, device, checks.FLOATS)
        fits = variance.shape == points.shape[:-1]
        require(fits, "variance", f"expected {tuple(points.shape[:-1])}", tuple(variance.shape), "give one per point")
        variance = variance.view(cloud.shape[:-1])
    T_base_links = _check_links(T_base_links, links, T_map_base is not None, B, device, check_values)
    if pose_covariance is not None:
        pose_covariance = _check_covariance(pose_covariance, B, S, device, check_values)
    if moving is not None:
        given = torch.full((num_envs,), moving, device=device) if isinstance(moving, bool) else moving
        moving = checks.check_mask("moving", given, num_envs, device)
    return Inputs(cloud, T_map_sensor, T_map_base, dt, variance, T_base_links, pose_covariance, moving)


def _check_covariance(
    covariance: Any, num_envs: int, num_sensors: int, device: torch.device, check_values: bool
) -> Float[Tensor, "B S 6 6"]:
    """Return the covariance of each sensor's pose; one that was given for all sensors is repeated."""
    value = checks.check_tensor("pose_covariance", covariance, device, checks.FLOATS)
    one, each = (num_envs, 6, 6), (num_envs, num_sensors, 6, 6)
    rule, hint = f"expected {one} or {each}", "give one 6 x 6 matrix for each: x, y, z and rotations about them"
    require(tuple(value.shape) in (one, each), "pose_covariance", rule, tuple(value.shape), hint)
    value = value if value.ndim == 4 else value[:, None].expand(each)
    if is_readable(value, check_values):
        checks.require_covariance("pose_covariance", value)
    return value


def _check_links(
    T_base_links: Any, links: tuple[str, ...], has_base: bool, num_envs: int, device: torch.device, check_values: bool
) -> Float[Tensor, "B K 4 4"] | None:
    """Return the poses of the links; they are required if the body has links, together with the base, and only then."""
    given = T_base_links is not None
    if not links:
        hint = "give sensor.body=RobotBody(...), or leave it out"
        require(not given, "T_base_links", "must be left out, as sensor.body has no links", "poses", hint)
        return None
    names = f"expected ({num_envs}, {len(links)}, 4, 4), the poses in the base frame of {', '.join(links)}"
    require(given, "T_base_links", names, "None", "compute them from the joint angles")
    hint = "give it, or sensor.body=None"
    require(has_base, "T_map_base", "is required to pose the links of sensor.body", "None", hint)
    return checks.check_pose("T_base_links", T_base_links, (num_envs, len(links), 4, 4), device, check_values)


def require_full_precision(dtype: torch.dtype) -> None:
    """Refuse to update a half-precision map, which can hold neither a cell number nor a variance of 1 mm^2."""
    hint = "call .float() on it; points may be of half precision"
    full = dtype in (torch.float32, torch.float64)
    require(full, "map", "must be float32 or float64 to take in points", dtype, hint, TypeError)


def _check_points(points: object, num_envs: int, device: torch.device) -> Float[Tensor, "B S N 3"]:
    value = checks.check_tensor("points", points, device, checks.FLOATS)
    fits = value.ndim in (3, 4) and value.shape[0] == num_envs and value.shape[-1] == 3
    if not fits:
        raise _wrong_shape(value, num_envs, device)
    value = value if value.ndim == 4 else value[:, None]
    require(value.shape[1] > 0, "points", "must have at least one sensor", tuple(value.shape), "give S >= 1")
    return value


def _wrong_shape(value: Tensor, num_envs: int, device: torch.device) -> ValueError:
    rule = f"expected (B, N, 3) or (B, S, N, 3) with B = {num_envs} on {device}"
    hint = "give one cloud per environment, padded with NaN"
    if value.ndim in (3, 4) and value.shape[-1] != 3:
        hint = "transpose the last two dimensions" if value.shape[-2] == 3 else "keep x, y and z alone: points[..., :3]"
    return ValueError(message("points", rule, f"{tuple(value.shape)} on {value.device}", hint))


def _check_dt(
    dt: object, num_envs: int, device: torch.device, dtype: torch.dtype, check_values: bool
) -> Float[Tensor, "B"]:
    hint = "give the seconds since the last update, or 0.0 for a further sensor of the same instant"
    require(dt is not None, "dt", "is required", "none", hint, TypeError)
    if isinstance(dt, Tensor):
        value = _check_dt_tensor(dt, num_envs, device, check_values).to(dtype)
        return value if value.ndim else value.expand(num_envs)
    is_number = isinstance(dt, (float, Real)) and not isinstance(dt, bool)  # float first: ten times as fast
    require(is_number, "dt", "must be a number or a tensor", type(dt).__name__, "give seconds", TypeError)
    seconds = float(dt)  # type: ignore[arg-type]
    good = math.isfinite(seconds) and seconds >= 0
    require(good, "dt", "must be finite and not negative", dt, "give the seconds since the last update")
    return torch.full((num_envs,), seconds, device=device, dtype=dtype)


def _check_dt_tensor(dt: Tensor, num_envs: int, device: torch.device, check_values: bool) -> Tensor:
    value = checks.check_tensor("dt", dt, device, checks.FLOATS)
    if value.shape not in ((), (num_envs,)):
        rule = f"expected a number or ({num_envs},)"
        raise ValueError(message("dt", rule, tuple(value.shape), "give one dt per environment"))
    if is_readable(value, check_values):
        seconds = value.reshape(-1).tolist()
        if not all(0 <= s < math.inf for s in seconds):
            bad = np.array([not 0 <= s < math.inf for s in seconds])
            actual = f"{seconds[bad.argmax()]:g}{checks.name_environments(bad)}"
            hint = "give the seconds since the last update"
            raise ValueError(message("dt", "must be finite and not negative", actual, hint))
    return value


def placeholder_inputs(
    num_envs: int,
    num_sensors: int,
    num_points: int,
    *,
    device: torch.device,
    with_base: bool,
    with_variance: bool,
    num_links: int,
    dtype: torch.dtype,
    pose_dtype: torch.dtype,
) -> Inputs:
    """Return inputs of these sizes and dtypes whose points are all NaN."""
    B, S, N = num_envs, num_sensors, num_points
    points = torch.full((1, 1, 1, 1), torch.nan, dtype=dtype, device=device).expand(B, S, N, 3)
    T = torch.eye(4, dtype=pose_dtype, device=device).expand(B, S, 4, 4)
    variance = torch.ones((1, 1, 1), dtype=dtype, device=device).expand(B, S, N) if with_variance else None
    links = T[:, :1].expand(B, num_links, 4, 4) if num_links else None
    return Inputs(points, T, T[:, 0] if with_base else None, torch.zeros(B, device=device), variance, links)
