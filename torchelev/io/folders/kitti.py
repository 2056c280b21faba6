"""Poses of KITTI's left camera, converted to the lidar's by the calibration beside them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError

_FILES = ("calib.txt", "calib_velo_to_cam.txt")
_TR_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")
_MIN_PATH = 1.0  # [m] below which the steps of a path show no direction of travel
_MIN_MOVE = 0.3  # [m] from the first pose to the last, below which they show none either
_STILL = 0.05  # [m], and of a rotation matrix
_LIDAR_HINT = "expected Tr: with 12 numbers, which takes points of the lidar into the camera"
_NO_CALIBRATION = (
    "the poses travel along their own z axis and upwards in the map, as a camera's do in KITTI's odometry benchmark: "
    "clouds need the lidar's; put calib.txt, with the line Tr, beside the scans or the poses"
)
_TOO_SHORT = (
    "the poses are taken as the lidar's; the path is too short to show whether they are the camera's, as in KITTI's "
    "odometry benchmark: map a longer part"
)


def to_lidar(T_map_sensor: NDArray, folders: Iterable[Path]) -> tuple[NDArray[np.float64], str]:
    """Return the poses of the lidar, converted if they are a camera's, and a note.

    A camera travels along its z axis, a lidar across it. The converted poses have a map frame whose z axis is up.

    Args:
        T_map_sensor: (T, 4, 4) poses as the pose file gives them.
        folders: where a calibration may be.

    Returns:
        The poses (T, 4, 4), unchanged if they are the lidar's or there is no calibration; and a note, or "".

    Raises:
        RecordingError: there is a calibration, the poses are a camera's, and it does not hold the lidar's place.
    """
    path = next((folder / name for folder in folders for name in _FILES if (folder / name).is_file()), None)
    is_short = path is not None and _path_length(T_map_sensor) < _MIN_PATH
    T_shown = T_map_sensor[[0, -1]] if is_short else T_map_sensor  # noise does not add up between two poses
    along_axis, upwards = _travel(T_shown, _MIN_MOVE if is_short else _MIN_PATH)
    if not along_axis:
        is_open = is_short and _path_length(T_shown) < _MIN_MOVE and not _is_unmoved(T_map_sensor)
        return T_map_sensor, f"{path}: {_TOO_SHORT}" if is_open else ""
    if path is None:
        return T_map_sensor, _NO_CALIBRATION if upwards else ""
    T_camera_lidar = _read_calibration(path)
    T_map_lidar = T_map_sensor @ T_camera_lidar
    note = f"the poses are the camera's, as they travel along their z axis: converted to the lidar's by {path}"
    return np.linalg.inv(T_camera_lidar) @ T_map_lidar if upwards else T_map_lidar, note


def _travel(T_map_sensor: NDArray, min_path: float) -> tuple[bool, bool]:
    """Return whether a sensor travels along its own z axis, and whether along the map's; neither on a short path."""
    steps = np.diff(T_map_sensor[:, :3, 3], axis=0)
    if _path_length(T_map_sensor) < min_path:
        return False, False
    own = np.einsum("tji,tj->ti", T_map_sensor[:-1, :3, :3], steps)
    return _is_along_z(own), _is_along_z(steps)


def _path_length(T_map_sensor: NDArray) -> float:
    return float(np.linalg.norm(np.diff(T_map_sensor[:, :3, 3], axis=0), axis=1).sum())


def _is_unmoved(T_map_sensor: NDArray) -> bool:
    """Return whether all poses are the identity: then a camera's and a lidar's poses give the same map."""
    return bool(np.abs(T_map_sensor - np.eye(4)).max() < _STILL)


def _is_along_z(steps: NDArray) -> bool:
    x, y, z = np.abs(steps).sum(axis=0)
    return bool(z > np.hypot(x, y))


def _read_calibration(path: Path) -> NDArray[np.float64]:
    rows = dict(line.split(":", 1) for line in path.read_text(errors="replace").splitlines() if ":" in line)
    T = np.eye(4)
    try:
        if "R" in rows and "T" in rows:
            T[:3, :3], T[:3, 3] = np.array(rows["R"].split(), float).reshape(3, 3), np.array(rows["T"].split(), float)
        else:
            T[:3] = np.array(next(rows[key] for key in _TR_KEYS if key in rows).split(), float).reshape(3, 4)
    except (StopIteration, ValueError) as error:
        problem = "does not hold the lidar's pose, and the poses are a camera's, as they travel along their z axis"
        raise RecordingError(path, problem, _LIDAR_HINT) from error
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 0.02:
        raise RecordingError(path, "Tr is no rigid transform", _LIDAR_HINT)
    return T
