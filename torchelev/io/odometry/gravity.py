"""The direction of up in the frame of lidar odometry: from the ground around the start, or from an IMU."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchelev.io.odometry.health import OdometryError
from torchelev.io.odometry.track import Track

GRAVITY = 9.80665  # [m/s^2]
_RADIUS, _CUBE = 15.0, 0.5  # [m] around the start, and side length of the cubes that count once each
_TRIALS, _NEAR = 300, 0.2  # planes that are tried, and distance [m] of the points on one
_TILT = np.cos(np.radians(45.0))  # of the ground against the prior
_MIN_SHARE = 0.2  # of the cubes on the ground
_IMU_SPAN = 20.0  # [s] over which the IMU is averaged
_MAGNITUDE = 0.8, 1.2  # of the mean force over gravity


def up_from_ground(points: NDArray[np.float64], prior: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the unit normal (3,) of the ground around the sensor; None if there is no plane below it.

    The plane is the one with most points (RANSAC), each cube of 0.5 m counting once, fitted to them by least squares.

    Args:
        points: [m] (M, 3) seen by the sensor, which is at the origin.
        prior: (3,) roughly up; the ground is tilted by less than 45 degrees against it.
    """
    near = points[np.linalg.norm(points, axis=1) < _RADIUS]
    _, first = np.unique(np.floor(near / _CUBE).astype(np.int64), axis=0, return_index=True)
    near, generator = near[first], np.random.default_rng(0)
    if len(near) < 3:
        return None
    best = np.zeros(len(near), bool)
    for _ in range(_TRIALS):
        on = _points_on(near, near[generator.choice(len(near), 3, replace=False)], prior)
        best = on if on.sum() > best.sum() else best
    if best.sum() < max(10, _MIN_SHARE * len(near)):
        return None
    return _normal(near[best], prior)


def _points_on(points: NDArray, three: NDArray, prior: NDArray) -> NDArray[np.bool_]:
    """Return which points lie on the plane through three; none if the plane is not ground below the origin."""
    normal = _normal(three, prior)
    is_ground = normal @ prior > _TILT and normal @ three[0] < 0
    return np.abs((points - three[0]) @ normal) < (_NEAR if is_ground else -1.0)


def _normal(points: NDArray, prior: NDArray) -> NDArray[np.float64]:
    normal = np.linalg.svd(points - points.mean(0))[2][2] if len(points) < 1000 else _eigen_normal(points)
    return normal if normal @ prior > 0 else -normal


def _eigen_normal(points: NDArray) -> NDArray[np.float64]:
    rest = points - points.mean(0)
    return np.linalg.eigh(rest.T @ rest)[1][:, 0]


def up_from_imu(
    track: Track, times: NDArray[np.float64], forces: NDArray[np.float64], R_sensor_imu: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the unit vector (3,) that points up in the track's frame, by an IMU's specific forces.

    The forces are turned into the track's frame by its poses and averaged over up to 20 s. The mean acceleration of the
    track, its change of velocity over the time, is subtracted. The biases of the IMU stay.

    Args:
        track: poses of the sensor.
        times: (M,) [s] by the clock of the track.
        forces: (M, 3) [m/s^2], or in g, as the IMU measures them: upwards where it rests.
        R_sensor_imu: (3, 3) turns vectors of the IMU's frame into the sensor's.

    Raises:
        OdometryError: there are too few values, or their mean is not gravity.
    """
    start, end = track.times[0], min(track.times[-1], track.times[0] + _IMU_SPAN)
    inside = (times >= start) & (times <= end) & np.isfinite(forces).all(1)
    if inside.sum() < 10:
        raise OdometryError(f"the IMU has {inside.sum()} values while the lidar was recorded, and 10 are needed")
    turned = np.einsum("kab,bc,kc->ka", track.at(times[inside])[:, :3, :3], R_sensor_imu, forces[inside])
    mean = turned.mean(0)
    size = float(np.linalg.norm(mean))
    unit = next((u for u in (GRAVITY, 1.0) if _MAGNITUDE[0] * u <= size <= _MAGNITUDE[1] * u), None)
    if unit is None:
        raise OdometryError(
            f"the IMU's mean acceleration is {size:.2f}, neither {GRAVITY:.2f} m/s^2 nor 1 g: gravity is taken out of "
            "it, or it has another unit; leave --imu out"
        )
    up = mean / unit * GRAVITY - _mean_acceleration(track, start, end)
    return up / np.linalg.norm(up)


def _mean_acceleration(track: Track, start: float, end: float) -> NDArray[np.float64]:
    """Return the change of velocity over time (3,) [m/s^2], between the first and the last half second."""
    part = min(0.5, (end - start) / 4)
    places = track.at(np.array([start, start + part, end - part, end]))[:, :3, 3]
    return (places[3] - places[2] - places[1] + places[0]) / part / max(end - start - part, 1e-3)


def align(up: NDArray[np.float64], ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) into a frame with z along `up` (3,), and x along `ahead` (3,) as seen from above."""
    x = ahead - (ahead @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
