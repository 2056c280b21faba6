"""A recording: scans and the sensor's poses, read one scan at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.io.errors import RecordingError
from torchelev.io.files.arrays import CloudFile
from torchelev.io.files.clouds import read_cloud_file
from torchelev.io.files.depth import read_depth, read_depth_points
from torchelev.io.files.intrinsics import Intrinsics, read_intrinsics
from torchelev.io.files.layout import FileLayout
from torchelev.io.folders.clock import ScanClock, find_clock
from torchelev.io.folders.kitti import to_lidar
from torchelev.io.folders.pairing import compute_steps, pair
from torchelev.io.folders.scan_files import find_scans
from torchelev.io.folders.within_scan import hold_still
from torchelev.io.labels import LabelImage
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
    colors: NDArray[np.float32] | None = None  #: (N, 3) of the points, from 0 to 1; None: none
    images: tuple[LabelImage, ...] = ()  #: taken after the scan and before the next one


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
        points, colors = self._read_points(path, index)
        dt = float(self.dt[index])
        return Frame(points, self.T_map_sensor[index], dt, path.name, base, colors=colors)

    def _read_points(self, path: Path, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return a scan's points (N, 3) [m], as seen from its pose, and their colours."""
        read, clock = self._read(path), self._clock
        cloud = read if isinstance(read, CloudFile) else CloudFile(read)
        if clock is None:
            points, notes = hold_still(cloud, None, 0.0, 0.0)
        else:
            points, notes = hold_still(cloud, clock.path, clock.stamps[index], clock.pose_times[index])
        for note in notes:
            self.notes.count(f"{path.name}: {note.text}", note.kind)
        return points, cloud.colors

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
    depth_scale: float | None = None,
    depth_axes: str | None = None,
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
        depth_scale: [m] per unit of depth; None: that of the intrinsics for integers, and 1 for floats.
        depth_axes: axes of the frame of depth images, see `depth_to_points`; None: optical.

    Returns:
        The recording. Scans are read when indexed.

    Raises:
        RecordingError: there are no scans, a scan has no pose, or a file cannot be read or contradicts its layout.
        ValueError: `depth_scale` or `depth_axes` is given for point clouds, or the scale is not positive.
    """
    layout = layout or FileLayout()
    camera = _read_camera(intrinsics, depth_scale, depth_axes)
    files = find_scans(Path(folder), depth=camera is not None)
    pose_file = Path(poses) if poses is not None else _find_poses(Path(folder))
    given = read_poses(pose_file, layout)
    pairing = pair(files, pose_file, given)
    taken = pairing.stamps if given.times is None else given.times[pairing.poses]
    steps = compute_steps(files, pose_file, taken, dt)
    T, notes = given.T_map_sensor, pairing.notes
    if camera is not None and files[0].suffix.lower() != ".png":
        read_depth(files[0], camera.depth_scale, camera.float_scale)  # an array may also be a cloud
    if camera is None:
        T, note = to_lidar(T, (files[0].parent, Path(folder), pose_file.parent, files[0].parent.parent))
        notes = (*notes, *filter(None, [note]))

    def read(path: Path) -> CloudFile:
        return read_cloud_file(path, layout) if camera is None else CloudFile(read_depth_points(path, camera))

    clock = find_clock(pairing, given.times, T, steps, dt)
    return Recording(files, T[pairing.poses], steps, read, "; ".join(notes), clock=clock)


def _read_camera(path: str | Path | None, scale: float | None, axes: str | None) -> Intrinsics | None:
    """Return the camera of depth images, with a unit and axes that were asked for; None: there are point clouds."""
    asked, given = [("--depth-scale", scale), ("--depth-axes", axes)], path is not None
    for name, value in asked:
        require(value is None or given, name, "is for depth images only", value, "give their camera with --intrinsics")
    rule = "must be positive and finite"
    require(scale is None or 0 < scale < math.inf, "--depth-scale", rule, scale, "give metres per unit")
    if path is None:
        return None
    camera = read_intrinsics(path)
    camera = camera if scale is None else camera._replace(depth_scale=scale, float_scale=scale)
    return camera if axes is None else camera._replace(axes=axes)


def _find_poses(folder: Path) -> Path:
    for place in (folder, folder.resolve().parent):
        for name in _POSE_FILES:
            if (place / name).is_file():
                return place / name
    names = " or ".join(_POSE_FILES)
    raise RecordingError(folder, f"no pose file ({names}) in it or beside it", "give it with --poses")
