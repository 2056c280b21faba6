"""A recording: scans and the sensor's poses, read one scan at a time."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError
from torchelev.io.folders.clouds import read_cloud
from torchelev.io.folders.depth import Intrinsics, check_size, read_depth, read_intrinsics
from torchelev.io.folders.layout import FileLayout, require_plausible_steps
from torchelev.io.folders.poses import Poses, read_poses
from torchelev.io.folders.scan_files import find_scans

_POSE_FILES = ("poses.txt", "groundtruth.txt")
_TIME_TOLERANCE = 0.02  # [s] between a scan's timestamp and its pose's, as in TUM's own tools
_DEFAULT_DT = 0.1  # [s]


class Frame(NamedTuple):
    """One scan of a recording."""

    points: NDArray[np.float32]  #: (N, 3) [m], sensor frame; NaN where there was no return
    T_map_sensor: NDArray[np.float64]  #: (4, 4)
    dt: float  #: [s] since the previous scan, 0 for the first
    name: str  #: file name or topic, for messages
    T_map_base: NDArray[np.float64] | None = None  #: (4, 4); None: unknown
    pose_covariance: NDArray[np.float64] | None = None  #: (6, 6) of the sensor's pose, see `ElevationMap.update`
    stamp: float = 0.0  #: [s] of a bag's scan; 0 of a file


class Recording(Sequence[Frame]):
    """Scans with poses. Indexing reads a scan from disk; a slice is a shorter recording.

    Args:
        files: T paths.
        T_map_sensor: (T, 4, 4) poses of the sensor.
        dt: (T,) [s] since the previous scan.
        read: reads the points (N, 3) [m] of a file.
        note: a warning on how scans were matched with poses, or "".
        T_map_base: (T, 4, 4) poses of the base; None: unknown.
    """

    def __init__(
        self,
        files: list[Path],
        T_map_sensor: NDArray,
        dt: NDArray,
        read: Callable[[Path], NDArray],
        note: str = "",
        T_map_base: NDArray | None = None,
    ) -> None:
        self.files, self.T_map_sensor, self.dt, self._read, self.note = files, T_map_sensor, dt, read, note
        self.T_map_base = T_map_base

    def __len__(self) -> int:
        return len(self.files)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Recording: ...
    def __getitem__(self, index: int | slice) -> Frame | Recording:
        if isinstance(index, slice):
            bases = None if self.T_map_base is None else self.T_map_base[index]
            return Recording(self.files[index], self.T_map_sensor[index], self.dt[index], self._read, self.note, bases)
        path, base = self.files[index], None if self.T_map_base is None else self.T_map_base[index]
        return Frame(self._read(path), self.T_map_sensor[index], float(self.dt[index]), path.name, base)

    @property
    def middle(self) -> NDArray[np.float64]:
        """The middle (3,) [m] of the sensor's path, map frame."""
        places = self.T_map_sensor[:, :3, 3]
        return (places.min(axis=0) + places.max(axis=0)) / 2

    def apply_mount(self, T_base_sensor: NDArray[np.float64]) -> Recording:
        """Return the recording with poses of the base turned into poses of the sensor: T_map_base T_base_sensor.

        Args:
            T_base_sensor: (4, 4) pose of the sensor on the robot.

        Returns:
            The same scans with the sensor's poses.
        """
        return Recording(self.files, self.T_map_sensor @ T_base_sensor, self.dt, self._read, self.note)

    def with_bases(self, T_map_base: NDArray[np.float64]) -> Recording:
        """Return the recording with poses (T, 4, 4) of the robot's base."""
        return Recording(self.files, self.T_map_sensor, self.dt, self._read, self.note, T_map_base)


def open_recording(
    folder: str | Path,
    poses: str | Path | None = None,
    intrinsics: str | Path | None = None,
    dt: float | None = None,
    layout: FileLayout | None = None,
) -> Recording:
    """Open a folder of point clouds, or of depth images if `intrinsics` is given.

    Scans are sorted by name, numbers by value. If their names are timestamps and the poses have timestamps of the same
    clock, each scan takes the pose nearest in time, within 20 ms. Otherwise scans and poses are paired in order; if
    there are more poses than scans, numbered scans take the pose of their number. Files that torchelev wrote are
    ignored.

    Args:
        folder: holds the scans, a folder `scans/` with them, or exactly one other subfolder with them.
        poses: the pose file, see `read_poses`; None: `poses.txt` or `groundtruth.txt` in `folder` or its parent.
        intrinsics: the camera of depth images, see `read_intrinsics`; None: the scans are point clouds.
        dt: [s] between scans; None: from the poses' timestamps, or 0.1.
        layout: what the files leave open; None: see `FileLayout`.

    Returns:
        The recording. Scans are read when indexed.

    Raises:
        RecordingError: there are no scans, a scan has no pose, or a file cannot be read or contradicts its layout.
    """
    layout = layout or FileLayout()
    camera = None if intrinsics is None else read_intrinsics(intrinsics)
    files = find_scans(Path(folder), depth=camera is not None)
    pose_file = Path(poses) if poses is not None else _find_poses(Path(folder))
    T_map_sensor, times, note = _assign_poses(files, pose_file, read_poses(pose_file, layout))

    def read(path: Path) -> NDArray:
        return read_cloud(path, layout) if camera is None else _read_depth_points(path, camera)

    return Recording(files, T_map_sensor, _compute_steps(files, pose_file, times, dt), read, note)


def _find_poses(folder: Path) -> Path:
    for place in (folder, folder.resolve().parent):
        for name in _POSE_FILES:
            if (place / name).is_file():
                return place / name
    names = " or ".join(_POSE_FILES)
    raise RecordingError(folder, f"no pose file ({names}) in it or beside it", "give it with --poses")


def _assign_poses(files: list[Path], pose_file: Path, poses: Poses) -> tuple[NDArray, NDArray | None, str]:
    """Return each scan's pose (T, 4, 4), its time (T,) [s] if known, and a note if poses are left over."""
    index, note = _match_times(files, pose_file, poses.times), ""
    if index is None:
        num_poses = len(poses.T_map_sensor)
        index = _match_order(files, pose_file, num_poses)
        if num_poses > len(files):
            lines = f"{files[0].name} takes line {index[0] + 1}, {files[-1].name} line {index[-1] + 1}"
            note = f"{pose_file}: {num_poses} poses for {len(files)} scans; each scan takes that of its number: {lines}"
    return poses.T_map_sensor[index], None if poses.times is None else poses.times[index], note


def _match_times(files: list[Path], pose_file: Path, times: NDArray | None) -> NDArray | None:
    """Return the indices (T,) of the poses nearest in time; None without timestamps of a common clock."""
    stamps = [_parse_timestamp(path.stem) for path in files]
    if times is None or None in stamps:
        return None
    scan_times = np.array(stamps, dtype=np.float64)
    if scan_times.max() < times.min() - 1 or scan_times.min() > times.max() + 1:
        return None  # different clocks
    index = np.array([np.abs(times - t).argmin() for t in scan_times])
    gaps = np.abs(times[index] - scan_times)
    if gaps.max() > _TIME_TOLERANCE:
        name, gap = files[int(gaps.argmax())].name, gaps.max()
        problem = f"no pose for scan {name}: the nearest is {gap:.3f} s away, at most {_TIME_TOLERANCE} s is allowed"
        raise RecordingError(pose_file, problem, "add its pose or remove the scan")
    return index


def _parse_timestamp(stem: str) -> float | None:
    """Return the time [s] in a file name: a decimal number, or s, ms, us or ns since 1970; None for other names."""
    if not re.fullmatch(r"\d+\.\d+|\d{10,19}", stem):
        return None
    value = float(stem)
    return value / 10 ** (3 * int(max(0, np.floor((np.log10(max(value, 1.0)) - 8) / 3))))


def _match_order(files: list[Path], pose_file: Path, num_poses: int) -> NDArray:
    """Return the indices (T,) of poses in the scans' order, or by the scans' numbers if there are more poses."""
    if num_poses == len(files):
        return np.arange(num_poses)
    if num_poses > len(files) and all(path.stem.isdigit() for path in files):
        index = np.array([int(path.stem) for path in files])
        if index.max() < num_poses:
            return index
    scan = f"no pose for scan {files[num_poses].name}: " if num_poses < len(files) else ""
    raise RecordingError(pose_file, f"{scan}{num_poses} poses for {len(files)} scans", "write one line for each scan")


def _compute_steps(files: list[Path], pose_file: Path, times: NDArray | None, dt: float | None) -> NDArray[np.float64]:
    """Return the times since the previous scan (T,) [s], 0 for the first."""
    if dt is not None or times is None:
        steps = np.full(len(files), _DEFAULT_DT if dt is None else dt)
    else:
        steps = np.diff(times, prepend=times[:1])
    steps[0] = 0.0
    if (steps < 0).any():
        name = files[int((steps < 0).argmax())].name
        raise RecordingError(pose_file, f"the pose of scan {name} is older than that of the scan before it", "sort it")
    if dt is None and times is not None:
        require_plausible_steps(pose_file, steps)
    return steps


def _read_depth_points(path: Path, camera: Intrinsics) -> NDArray[np.float32]:
    """Read a depth image as points (H * W, 3) [m] in the camera frame: x right, y down, z forward."""
    import torch

    from torchelev.inputs.clouds import depth_to_points

    depth = read_depth(path, camera.depth_scale)
    check_size(path, camera, depth.shape)
    matrix = torch.from_numpy(camera.matrix).float()
    return depth_to_points(torch.from_numpy(depth)[None], matrix, along=camera.along)[0].numpy()
