"""Poses of KITTI's left camera, turned into the lidar's by the calibration beside them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError

_FILES = ("calib.txt", "calib_velo_to_cam.txt")
_TR_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")
_MIN_PATH = 1.0  # [m] below which a path shows no direction of travel
_LIDAR_HINT = "expected Tr: with 12 numbers, which takes points of the lidar into the camera"
_NO_CALIBRATION = (
    "the poses travel along their own z axis, and upwards in the map, as those of a camera do (KITTI's odometry): "
    "clouds need the lidar's; put calib.txt, with the line Tr, beside the scans or the poses"
)

_TOO_SHORT = (
    "the poses are taken as the lidar's; their path is too short to show whether they are the camera's, as KITTI's "
    "odometry has them: map a longer part"
)


def to_lidar(T_map_sensor: NDArray, folders: Iterable[Path]) -> tuple[NDArray[np.float64] | None, str]:
    """Return how poses become those of the lidar, if they are a camera's, and a note.

    A camera travels along its z axis, a lidar across it.

    Args:
        T_map_sensor: (T, 4, 4) poses as the pose file gives them.
        folders: where a calibration may be.

    Returns:
        T_camera_lidar (4, 4), None if the poses are the lidar's or no calibration was found; and a note, or "".

    Raises:
        RecordingError: there is a calibration, the poses are a camera's, and it does not hold the lidar's place.
    """
    path = next((folder / name for folder in folders for name in _FILES if (folder / name).is_file()), None)
    along_axis, upwards = _travel(T_map_sensor)
    if not along_axis:
        is_open = path is not None and _path_length(T_map_sensor) < _MIN_PATH and not _is_unturned(T_map_sensor)
        return None, f"{path}: {_TOO_SHORT}" if is_open else ""
    if path is None:
        return None, _NO_CALIBRATION if upwards else ""
    note = f"the poses are the camera's, as they travel along their z axis: turned into the lidar's by {path}"
    return _read_calibration(path), note


def convert(T_map_camera: NDArray, T_camera_lidar: NDArray) -> NDArray[np.float64]:
    """Return the lidar's poses (T, 4, 4), in a map frame whose z axis is up if the camera's was not."""
    T_map_lidar = T_map_camera @ T_camera_lidar
    return np.linalg.inv(T_camera_lidar) @ T_map_lidar if _travel(T_map_camera)[1] else T_map_lidar


def _travel(T_map_sensor: NDArray) -> tuple[bool, bool]:
    """Return whether a sensor travels along its own z axis, and whether along the map's."""
    steps = np.diff(T_map_sensor[:, :3, 3], axis=0)
    if _path_length(T_map_sensor) < _MIN_PATH:
        return False, False
    own = np.einsum("tji,tj->ti", T_map_sensor[:-1, :3, :3], steps)
    return _is_along_z(own), _is_along_z(steps)


def _path_length(T_map_sensor: NDArray) -> float:
    return float(np.linalg.norm(np.diff(T_map_sensor[:, :3, 3], axis=0), axis=1).sum())


def _is_unturned(T_map_sensor: NDArray) -> bool:
    """Return whether all poses have the axes of the map, so that a camera's and a lidar's give the same map."""
    return bool(np.abs(T_map_sensor[:, :3, :3] - np.eye(3)).max() < 0.05)


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
        problem = "holds no place of the lidar, and the poses are a camera's, as they travel along their z axis"
        raise RecordingError(path, problem, _LIDAR_HINT) from error
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 0.02:
        raise RecordingError(path, "Tr is no rigid transform", _LIDAR_HINT)
    return T
