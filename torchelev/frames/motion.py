"""Poses between poses, and the motion within a scan.

A scan takes time: a spinning lidar needs 0.1 s for a turn, in which the robot moves. `deskew` moves each point to where
the sensor would have seen it at one instant.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.ops.transforms import is_readable

if TYPE_CHECKING:
    from jaxtyping import Float

_FLOATS = (torch.float32, torch.float64)


class _Segments(NamedTuple):
    """The motion from each pose to the next, at M times."""

    start: Float[Tensor, "B M 4 4"]  #: pose at the start of the segment
    rotation: Float[Tensor, "B M 3"]  #: [rad] rotation vector from there to the time, in axes of the start
    shift: Float[Tensor, "B M 3"]  #: [m] translation from there to the time


def interpolate_poses(
    poses: Float[Tensor, "B K 4 4"],
    stamps: Float[Tensor, "B K"],
    times: Float[Tensor, "B M"],
    max_extrapolation: float = 0.1,
) -> Float[Tensor, "B M 4 4"]:
    """Return the poses at given times, between two known ones: positions linearly, rotations by slerp.

    T(t) = (R_k exp(u log(R_k^T R_k+1)), (1 - u) p_k + u p_k+1) with u = (t - t_k) / (t_k+1 - t_k). Before the first
    pose and after the last, the motion of the first or last two continues. Differentiable in poses and times.

    Args:
        poses: known poses; K is at least 2. Neighbours must differ by less than half a turn.
        stamps: times [s] of the poses, increasing; give float64.
        times: [s] of the poses that are asked for.
        max_extrapolation: [s] by which a time may lie before the first stamp or after the last.

    Returns:
        The poses, in the dtype of `poses`; NaN where a time is not finite, or farther outside.

    Raises:
        ValueError: a shape does not fit, there are fewer than two poses, or, on the CPU, stamps do not increase.
    """
    _check(poses, stamps, max_extrapolation)
    B = len(poses)
    fits = times.ndim == 2 and len(times) == B
    require(fits, "times", f"expected ({B}, M)", tuple(times.shape), "give times for each environment")
    segments = _find_segments(poses, stamps, times, max_extrapolation)
    T = segments.start.clone()
    T[..., :3, :3] = segments.start[..., :3, :3] @ _turn(segments.rotation[..., None, :], _rows(T)).mT
    T[..., :3, 3] = segments.start[..., :3, 3] + segments.shift
    return T


def deskew(
    points: Float[Tensor, "B N 3"],
    times: Float[Tensor, "B N"],
    poses: Float[Tensor, "B K 4 4"],
    stamps: Float[Tensor, "B K"],
    at: Float[Tensor, "B"],
    max_extrapolation: float = 0.1,
) -> Float[Tensor, "B N 3"]:
    """Move the points of a scan to one instant, p' = T(at)^-1 T(t_i) p_i, with the poses of `interpolate_poses`.

    ```python
    points = deskew(points, times, T_map_sensor, stamps, at=scan_time)
    emap.update(points, interpolate_poses(T_map_sensor, stamps, scan_time[:, None])[:, 0], T_map_base, dt=0.1)
    ```

    Works in batches and without waiting for the device. Differentiable in points, times and poses.

    Args:
        points: [m] each in the sensor's frame at its own time.
        times: [s] when each point was measured, by the clock of `stamps`; give float64.
        poses: poses of the sensor, T_map_sensor; K is at least 2.
        stamps: times [s] of the poses, increasing.
        at: [s] the instant, such as the stamp of the scan.
        max_extrapolation: [s] by which a time may lie before the first stamp or after the last.

    Returns:
        The points in the sensor's frame at the instant, in their dtype; NaN where the point or its time is, and where a
        time is farther outside. Maps ignore such points.

    Raises:
        ValueError: a shape does not fit, there are fewer than two poses, or, on the CPU, stamps do not increase.
    """
    B, N = points.shape[0], points.shape[1] if points.ndim > 1 else 0
    require(points.shape == (B, N, 3), "points", "expected (B, N, 3)", tuple(points.shape), "give one cloud for each")
    require(times.shape == (B, N), "times", f"expected ({B}, {N})", tuple(times.shape), "give one per point")
    require(at.shape == (B,), "at", f"expected ({B},)", tuple(at.shape), "give one instant per cloud")
    T_at = interpolate_poses(poses, stamps, at[:, None], max_extrapolation)
    # Relative to the instant before the precision is that of the points: 100 km away, float32 misses centimetres.
    relative = torch.linalg.inv(T_at) @ poses
    segments = _find_segments(relative, stamps, times, max_extrapolation)
    dtype = torch.promote_types(points.dtype, torch.float32)  # halves would lose centimetres
    T, rotation, shift = (value.to(dtype) for value in segments)
    moved = (T[..., :3, :3] @ _turn(rotation, points.to(dtype))[..., None])[..., 0] + T[..., :3, 3] + shift
    return moved.to(points.dtype)


def _check(poses: Tensor, stamps: Tensor, max_extrapolation: float) -> None:
    fits = poses.ndim == 4 and poses.shape[-2:] == (4, 4) and poses.dtype in _FLOATS
    require(fits, "poses", "expected (B, K, 4, 4) of floats", f"{tuple(poses.shape)} {poses.dtype}", "give matrices")
    B, K = poses.shape[:2]
    require(K >= 2, "poses", "must be at least two", K, "give the poses before and after the scan")
    require(stamps.shape == (B, K), "stamps", f"expected ({B}, {K})", tuple(stamps.shape), "give one per pose")
    limit, hint = max_extrapolation, "give seconds, such as the period of the scans"
    require(0 <= limit < math.inf, "max_extrapolation", "must be finite and not negative", limit, hint)
    if is_readable(stamps):
        increasing = bool((stamps[:, 1:] > stamps[:, :-1]).all())
        require(increasing, "stamps", "must increase", "others", "sort the poses, and leave out repeated ones")


def _find_segments(poses: Tensor, stamps: Tensor, times: Tensor, max_extrapolation: float) -> _Segments:
    """Find the motion between the two poses around each time."""
    known = stamps.detach().contiguous()
    k = torch.searchsorted(known, times.detach().to(known.dtype).contiguous(), right=True) - 1
    k = k.clamp(0, stamps.shape[1] - 2)
    start, end = stamps.gather(1, k), stamps.gather(1, k + 1)
    u = (times - start) / (end - start)
    inside = (times >= stamps[:, :1] - max_extrapolation) & (times <= stamps[:, -1:] + max_extrapolation)
    u = torch.where(inside, u, torch.nan).to(poses.dtype)[..., None]
    R, p = poses[..., :3, :3], poses[..., :3, 3]
    rotation, shift = _rotation_vector(R[:, :-1].mT @ R[:, 1:]), p[:, 1:] - p[:, :-1]
    index = k[..., None].expand(-1, -1, 3)
    T = poses.flatten(2).gather(1, k[..., None].expand(-1, -1, 16)).unflatten(-1, (4, 4))
    return _Segments(T, u * rotation.gather(1, index), u * shift.gather(1, index))


def _rotation_vector(R: Float[Tensor, "... 3 3"]) -> Float[Tensor, "... 3"]:
    """Return log(R) [rad]: the axis times the angle."""
    sine = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1) / 2
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    length = sine.square().sum(-1, keepdim=True).clamp(min=1e-30).sqrt()  # a gradient exists at no rotation, too
    return sine * torch.atan2(length, cosine) / length


def _turn(rotation: Float[Tensor, "... 3"], vectors: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
    """Turn vectors v by rotation vectors w [rad], by Rodrigues' formula, with a = |w|.

    v + sin(a)/a w x v + (1 - cos(a))/a^2 w x (w x v)
    """
    angle = rotation.square().sum(-1, keepdim=True).clamp(min=1e-30).sqrt()
    rotation, vectors = torch.broadcast_tensors(rotation, vectors)
    once = torch.linalg.cross(rotation, vectors)
    # sinc keeps both factors finite at an angle of 0, where they are 1 and 1/2.
    sine, cosine = torch.sinc(angle / math.pi), torch.sinc(angle / (2 * math.pi)).square() / 2
    return vectors + sine * once + cosine * torch.linalg.cross(rotation, once)


def _rows(T: Tensor) -> Tensor:
    """Return the unit vectors, (..., 3, 3), one for each pose."""
    return torch.eye(3, dtype=T.dtype, device=T.device).expand(*T.shape[:-2], 3, 3)
