"""Points without a reflecting surface: at the sensor's limit, with one range or depth, or on its own path."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.diagnosis.evidence import MIN_POINTS, Evidence

_MIN_SHARE = 0.01  # of a sensor's points; of sound ones, less than 0.2 % lie within the tolerance of the farthest
_TOLERANCE = 1e-4  # relative; rounding error of a float32 range after a transform or two
_MAX_SHARE = 0.999  # a sensor that stands in the middle of a round room sees one range everywhere
_MAX_RATIO = 2.5  # of lateral to forward distance, in the view of a camera
_MOVED = 0.05  # [m], and sine of an angle, by which a wall would have come nearer or turned
_PATH_WIDTH = 0.03  # [m] around the sensor's path, on which nothing can stand
_AXES = ((2, 1.0), (2, -1.0), (0, 1.0))  # that cameras look along, z, -z or x: optical, OpenGL, forward


class _Cloud(NamedTuple):
    """One sensor's usable points in one update."""

    points: NDArray  #: (n, 3) [m] sensor frame, neither too near nor too far
    used: NDArray  #: (n,) bool: passed all gates
    T: NDArray  #: (4, 4) T_map_sensor


def find_shared_range(seen: Evidence) -> str | None:
    """Find points at the limit of a sensor: many share its largest range, or its largest depth along the axis."""
    tolerance = max(_TOLERANCE, 2 * seen.epsilon)
    if tolerance > 5e-3:  # bfloat16 is too coarse
        return None
    for clouds in _clouds_by_sensor(seen):
        if sum(len(cloud.points) for cloud in clouds) >= MIN_POINTS:
            found = _find_shell(clouds, tolerance) or _find_screen(clouds, tolerance)
            if found:
                return found
    return None


def _find_shell(clouds: list[_Cloud], tolerance: float) -> str | None:
    """Find one range in many directions."""
    share, limit, at_limit = _share_largest(
        clouds, [np.linalg.norm(cloud.points, axis=1) for cloud in clouds], tolerance
    )
    if share < _MIN_SHARE or not _is_shell(clouds, at_limit, share, 0.3 * tolerance):
        return None
    return (
        f"points: {_percent(share)} of the points share one range of {limit:.2f} m, the largest: the sensor's limit, "
        "at which misses are no hits; make such points NaN, or set sensor.max_distance a little lower"
    )


def _find_screen(clouds: list[_Cloud], tolerance: float) -> str | None:
    """Find one depth along the axis of a camera."""
    points = np.concatenate([cloud.points for cloud in clouds])
    for column, sign in _AXES:
        if not _looks_along(points, column, sign):
            continue
        depths = [sign * cloud.points[:, column] for cloud in clouds]
        share, limit, at_limit = _share_largest(clouds, depths, tolerance)
        if share >= _MIN_SHARE and _is_screen(clouds, at_limit, column, sign, limit):
            return (
                f"points: {_percent(share)} of the points share one depth of {limit:.2f} m along the sensor's axis, "
                "the largest, wherever it is: its limit, at which misses are no hits; set such depths to 0 or NaN"
            )
    return None


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def _clouds_by_sensor(seen: Evidence) -> Iterator[list[_Cloud]]:
    """Yield the clouds of each sensor over all updates."""
    for s in range(len(seen.points[0])):
        clouds = []
        for k, sensors in enumerate(seen.points):
            size = len(sensors[s])
            rows = slice(s * size, (s + 1) * size)
            counts = seen.used[k][rows] | seen.overhang[k][rows]
            clouds.append(_Cloud(sensors[s][counts], seen.used[k][rows][counts], seen.poses[k][s]))
        yield [cloud for cloud in clouds if len(cloud.points)]


def _share_largest(clouds: list[_Cloud], values: list[NDArray], tolerance: float) -> tuple[float, float, list[NDArray]]:
    """Return the share of the points with the largest value, that value, and which points have it, per cloud.

    The share is 0 unless enough of them entered the map: those above the ramp only mark free space, correctly.
    """
    limit = max((float(part.max()) for part in values), default=0.0)
    at_limit = [part >= limit * (1 - tolerance) for part in values]
    num_used = sum(int((mask & cloud.used).sum()) for mask, cloud in zip(at_limit, clouds, strict=True))
    number, total = sum(int(mask.sum()) for mask in at_limit), sum(map(len, values))
    return (number / total if num_used >= MIN_POINTS else 0.0), limit, at_limit


def _is_shell(clouds: list[_Cloud], at_limit: list[NDArray], share: float, precision: float) -> bool:
    """Return whether points of one range lie in directions in which no surface but a sphere has one range.

    A lidar's ring on flat ground is a circle, a round wall is met by two, and both lie on quadrics other than spheres.
    A circle around the sensor itself is a plane scanner's limit if it moves along.
    """
    points = np.concatenate([cloud.points[mask] for cloud, mask in zip(clouds, at_limit, strict=True)])
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    x, y, z = directions.T
    quadrics = np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z], 1)
    if _smallest(quadrics) > precision:
        return share < _MAX_SHARE or _has_moved(clouds, at_limit)
    return _smallest(directions) < precision and _has_moved(clouds, at_limit)


def _smallest(columns: NDArray) -> float:
    """Return the smallest singular value of columns (n, c), per row: 0 if the rows satisfy a linear equation."""
    return float(np.linalg.svd(columns / np.sqrt(len(columns)), compute_uv=False)[-1])


def _has_moved(clouds: list[_Cloud], at_limit: list[NDArray]) -> bool:
    """Return whether the sensor moved between updates with such points."""
    places = np.array([cloud.T[:3, 3] for cloud, mask in zip(clouds, at_limit, strict=True) if mask.sum() >= 5])
    return len(places) > 1 and float(np.ptp(places, axis=0).max()) > _MOVED


def _looks_along(points: NDArray, column: int, sign: float) -> bool:
    """Return whether all points lie in the view of a camera with this axis."""
    forward = sign * points[:, column]
    lateral = np.delete(points, column, axis=1)
    return bool((np.linalg.norm(lateral, axis=1) < _MAX_RATIO * forward).mean() > _MAX_SHARE)


def _is_screen(clouds: list[_Cloud], at_limit: list[NDArray], column: int, sign: float, limit: float) -> bool:
    """Return whether points of one depth fill a part of the image and move with the sensor, unlike a wall.

    The last row of level ground has one depth, too, but is a line.
    """
    parts = [cloud.points[mask] for cloud, mask in zip(clouds, at_limit, strict=True)]
    points = np.concatenate(parts)
    lateral = np.delete(points, column, axis=1) / points[:, column, None]
    if _smallest(np.column_stack([lateral, np.ones(len(points))])) < 1e-3:
        return False
    shown = [cloud.T for cloud, part in zip(clouds, parts, strict=True) if len(part) >= 5]
    normals = np.array([sign * T[:3, column] for T in shown])
    offsets = np.array([normal @ T[:3, 3] + limit for normal, T in zip(normals, shown, strict=True)])
    turns = np.linalg.norm(np.cross(normals, normals[0]), axis=1)
    return bool((turns > _MOVED).any() or np.ptp(offsets) > _MOVED)


def find_points_on_path(seen: Evidence) -> str | None:
    """Find points on the sensor's own path during the scan: missing returns at the origin, moved by deskewing."""
    counts, total = [], 0
    for k in range(len(seen.numbers) - 1):
        if seen.numbers[k + 1] != seen.numbers[k] + 1:
            continue
        here, there = seen.poses[k][0][:3, 3], seen.poses[k + 1][0][:3, 3]
        step = there - here
        if not np.linalg.norm(step) > _PATH_WIDTH:
            continue
        points = seen.used_points(k)
        along = np.clip((points - here) @ step / (step @ step), -1, 1)
        away = np.linalg.norm(points - here - along[:, None] * step, axis=1)
        number, around = int((away < _PATH_WIDTH).sum()), int((away < 3 * _PATH_WIDTH).sum())
        counts.append(number if number > 0.8 * around else 0)  # ground on which the sensor's frame lies is wider
        total += len(points)
    if not counts or sum(counts) < MIN_POINTS or np.mean(np.array(counts) >= 5) < 0.5:
        return None
    return (
        f"points: {_percent(sum(counts) / total)} of the points lie on the sensor's own path, as missing returns of a "
        "cloud whose motion was taken out: make points of range 0 NaN before they are moved"
    )
