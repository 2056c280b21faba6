"""A recording: scans and the sensor's poses, read one scan at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from torchelev.io.clouds import read_cloud_file
from torchelev.io.depth import read_depth, read_depth_points
from torchelev.io.errors import RecordingError
from torchelev.io.files.arrays import CloudFile
from torchelev.io.files.intrinsics import read_intrinsics
from torchelev.io.files.layout import FileLayout
from torchelev.io.folders.kitti import convert, to_lidar
from torchelev.io.folders.pairing import Pairing, compute_steps, pair
from torchelev.io.folders.scan_files import find_scans
from torchelev.io.folders.within_scan import SensorPath, hold_still
from torchelev.io.notes import Reasons
from torchelev.io.poses import read_poses

_POSE_FILES = ("poses.txt", "groundtruth.txt")


class Frame(NamedTuple):
    """One scan of a recording."""

    points: NDArray[np.float32]  #: (N, 3) [m], sensor frame; NaN where there was no return
    T_map_sensor: NDArray[np.float64]  #: (4, 4)
    dt: float  #: [s] since the previous scan, 0 for the first
    name: str  #: file name or topic, for messages
    T_map_base: NDArray[np.float64] | None = None  #: (4, 4); None: unknown
    pose_covariance: NDArray[np.float64] | None = None  #: (6, 6) of the sensor's pose, see `ElevationMap.update`
    stamp: float = 0.0  #: [s] of a bag's scan; 0 of a file


class ScanClock(NamedTuple):
    """When the scans and their poses were taken."""

    path: SensorPath
    stamps: NDArray[np.float64]  #: (T,) [s] from which the times of a scan's points count
    pose_times: NDArray[np.float64]  #: (T,) [s] of the pose that a scan takes

    def part(self, index: slice) -> ScanClock:
        """Return the clock of some of the scans."""
        return self._replace(stamps=self.stamps[index], pose_times=self.pose_times[index])

    def apply_mount(self, T_base_sensor: NDArray[np.float64]) -> ScanClock:
        """Return the clock with the path of a sensor at T_base_sensor (4, 4) on what moved along this one."""
        path = self.path._replace(T_map_sensor=self.path.T_map_sensor @ T_base_sensor)
        return self._replace(path=path)


class Recording(Sequence[Frame]):
    """Scans with poses. Indexing reads a scan from disk; a slice is a shorter recording.

    Args:
        files: T paths.
        T_map_sensor: (T, 4, 4) poses of the sensor.
        dt: (T,) [s] since the previous scan.
        read: reads the cloud of a file, or its points (N, 3) [m].
        note: a warning on how scans were matched with poses, or "".
        T_map_base: (T, 4, 4) poses of the base; None: unknown.
        clock: when scans and poses were taken; None: unknown.

    Attributes:
        notes: what is not used of the scans that were read.
    """

    def __init__(
        self,
        files: list[Path],
        T_map_sensor: NDArray,
        dt: NDArray,
        read: Callable[[Path], CloudFile | NDArray],
        note: str = "",
        T_map_base: NDArray | None = None,
        clock: ScanClock | None = None,
    ) -> None:
        self.files, self.T_map_sensor, self.dt, self._read, self.note = files, T_map_sensor, dt, read, note
        self.T_map_base, self._clock, self.notes = T_map_base, clock, Reasons()

    def __len__(self) -> int:
        return len(self.files)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Recording: ...
    def __getitem__(self, index: int | slice) -> Frame | Recording:
        bases = self.T_map_base
        if isinstance(index, slice):
            clock = None if self._clock is None else self._clock.part(index)
            part = Recording(self.files[index], self.T_map_sensor[index], self.dt[index], self._read, self.note,
                             None if bases is None else bases[index], clock)  # fmt: skip
            part.notes = self.notes
            return part
        path, base = self.files[index], None if bases is None else bases[index]
        return Frame(self._read_points(path, index), self.T_map_sensor[index], float(self.dt[index]), path.name, base)

    def _read_points(self, path: Path, index: int) -> NDArray[np.float32]:
        """Return a scan's points (N, 3) [m], as seen from its pose."""
        read, clock = self._read(path), self._clock
        cloud = read if isinstance(read, CloudFile) else CloudFile(read)
        if clock is None:
            points, notes = hold_still(cloud, None, 0.0, 0.0)
        else:
            points, notes = hold_still(cloud, clock.path, clock.stamps[index], clock.pose_times[index])
        for note in notes:
            self.notes.count(f"{path.name}: {note.text}", note.kind)
        return points

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
        clock = None if self._clock is None else self._clock.apply_mount(T_base_sensor)
        poses = self.T_map_sensor @ T_base_sensor
        return Recording(self.files, poses, self.dt, self._read, self.note, clock=clock)

    def with_bases(self, T_map_base: NDArray[np.float64]) -> Recording:
        """Return the recording with poses (T, 4, 4) of the robot's base."""
        return Recording(self.files, self.T_map_sensor, self.dt, self._read, self.note, T_map_base, self._clock)


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
    given = read_poses(pose_file, layout)
    pairing = pair(files, pose_file, given)
    taken = pairing.stamps if given.times is None else given.times[pairing.poses]
    steps = compute_steps(files, pose_file, taken, dt)
    T, notes = given.T_map_sensor, pairing.notes
    if camera is not None and files[0].suffix.lower() != ".png":
        read_depth(files[0])  # an array may also be a cloud
    if camera is None:
        T_camera_lidar, note = to_lidar(T, (files[0].parent, Path(folder), pose_file.parent, files[0].parent.parent))
        T, notes = T if T_camera_lidar is None else convert(T, T_camera_lidar), (*notes, *filter(None, [note]))

    def read(path: Path) -> CloudFile:
        return read_cloud_file(path, layout) if camera is None else CloudFile(read_depth_points(path, camera))

    clock = _find_clock(pairing, given.times, T, steps, dt)
    return Recording(files, T[pairing.poses], steps, read, "; ".join(notes), clock=clock)


def _find_poses(folder: Path) -> Path:
    for place in (folder, folder.resolve().parent):
        for name in _POSE_FILES:
            if (place / name).is_file():
                return place / name
    names = " or ".join(_POSE_FILES)
    raise RecordingError(folder, f"no pose file ({names}) in it or beside it", "give it with --poses")


def _find_clock(
    pairing: Pairing, times: NDArray | None, T_map_sensor: NDArray, steps: NDArray, dt: float | None
) -> ScanClock | None:
    """Return when scans and poses were taken: by the poses' times, by the scans' names, or by `dt`; None: unknown."""
    stamps, pose_times = pairing.stamps, times
    if times is None:
        stamps = np.cumsum(steps) if dt else stamps
        pose_times, T_map_sensor = stamps, T_map_sensor[pairing.poses]
    if stamps is None or pose_times is None or len(np.unique(pose_times)) < 2:
        return None
    unique, first = np.unique(pose_times, return_index=True)
    forward = steps[steps > 0]
    period = float(np.median(forward)) if len(forward) else None
    taken = stamps if times is None else times[pairing.poses]
    return ScanClock(SensorPath(unique, T_map_sensor[first], period), stamps, taken)
