"""A recording: scans and the poses they were taken from, read one at a time."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from torchelev.io.clouds import CLOUD_READERS, known_formats, read_cloud
from torchelev.io.depth import Intrinsics, check_size, read_depth, read_intrinsics
from torchelev.io.errors import RecordingError
from torchelev.io.layout import FileLayout, require_plausible_steps
from torchelev.io.poses import Poses, read_poses
from torchelev.output_files import is_own_output

# Files that lie beside scans and are none; anything else that we cannot read is reported, not skipped.
BESIDE_SCANS = {"", ".txt", ".csv", ".json", ".yaml", ".yml", ".md", ".log", ".png", ".jpg", ".jpeg"}
POSE_FILES = ("poses.txt", "groundtruth.txt")
SCANS_FOLDER = "scans"  # wins over scans beside it
TIME_TOLERANCE = 0.02  # [s] between a scan named by its time and its pose, as TUM's own tools allow


class Frame(NamedTuple):
    """One scan of a recording."""

    points: NDArray[np.float32]  #: (N, 3) [m], sensor frame; NaN where the sensor saw nothing
    T_map_sensor: NDArray[np.float64]  #: (4, 4)
    dt: float  #: [s] since the scan before, 0 for the first
    name: str  #: file name, for messages


class Recording(Sequence[Frame]):
    """Scans with poses. Indexing reads one scan from disk; nothing is kept.

    `files` (T), `T_map_sensor` (T, 4, 4) and `dt` (T,) [s] are known from the start. `read` takes a file to its points
    (N, 3) [m]. `note` says how scans found their poses, where that may be a mistake.
    """

    def __init__(
        self, files: list[Path], T_map_sensor: NDArray, dt: NDArray, read: Callable[[Path], NDArray], note: str = ""
    ) -> None:
        self.files, self.T_map_sensor, self.dt, self._read, self.note = files, T_map_sensor, dt, read, note

    def __len__(self) -> int:
        return len(self.files)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Recording: ...
    def __getitem__(self, index: int | slice) -> Frame | Recording:
        if isinstance(index, slice):
            return Recording(self.files[index], self.T_map_sensor[index], self.dt[index], self._read, self.note)
        path = self.files[index]
        return Frame(self._read(path), self.T_map_sensor[index], float(self.dt[index]), path.name)

    def moved(self, T_base_sensor: NDArray[np.float64]) -> Recording:
        """The same scans, for a pose file that has the poses of the robot's base: T_map_base T_base_sensor."""
        return Recording(self.files, self.T_map_sensor @ T_base_sensor, self.dt, self._read, self.note)


def open_recording(
    folder: str | Path,
    poses: str | Path | None = None,
    intrinsics: str | Path | None = None,
    dt: float | None = None,
    layout: FileLayout | None = None,
) -> Recording:
    """Open a folder of scans, or of depth PNGs if `intrinsics` is given.

    `folder` holds `scans/`, the scans themselves or one sub-folder that does; maps and pictures that this package wrote
    are no scans. `poses` defaults to a `poses.txt` there or one folder up.
    Scans in the order of their names (numbers by value) take the poses in the order of their lines; a file with more
    poses than scans is indexed by the scans' numbers, and scans named by their time take the pose nearest in time, at
    most 20 ms off. `dt` [s] is the time between scans; None takes it from the poses' times, or 0.1. `layout` says what
    files do not say of themselves. Raises RecordingError if a scan has no pose, a file cannot be read or looks like
    another layout, or there is nothing to read.
    """
    layout = layout or FileLayout()
    camera = None if intrinsics is None else read_intrinsics(intrinsics)
    files = find_scans(Path(folder), depth=camera is not None)
    pose_file = Path(poses) if poses is not None else _find_poses(Path(folder))
    matrices, times, note = _assign(files, pose_file, read_poses(pose_file, layout))

    def read(path: Path) -> NDArray:
        return read_cloud(path, layout) if camera is None else _depth_points(path, camera)

    return Recording(files, matrices, _steps(files, pose_file, times, dt), read, note)


def find_scans(folder: Path, depth: bool = False) -> list[Path]:
    """Scans of `folder`/scans, of `folder` or of its one sub-folder with some, in natural order (2 before 10)."""
    if not folder.is_dir():
        problem = "is a file, not a folder" if folder.exists() else "no such folder"
        raise RecordingError(folder, problem, "give the folder that holds the scans")
    for place in _places(folder, depth):
        files = [path for path in place.iterdir() if _is_candidate(path)]
        scans = [path for path in files if _is_scan(path, depth)]
        if scans:
            _refuse_others(scans, [] if depth else files)
            return sorted(scans, key=_natural_key)
        if place == folder:
            _refuse_unreadable(files, depth)
    wanted = "depth .png" if depth else known_formats()
    found = sorted({path.suffix or path.name for path in folder.rglob("*") if path.is_file()})
    problem = f"holds no scan, only {' '.join(found[:8])}" if found else "holds no scan"
    raise RecordingError(folder, problem, f"expected files of one format among {wanted}")


def _places(folder: Path, depth: bool) -> Iterator[Path]:
    """Where scans may be, by precedence."""
    own = folder / SCANS_FOLDER
    if own.is_dir() and any(_is_scan(path, depth) for path in own.iterdir()):
        yield own
    yield folder
    yield from _subfolders(folder, depth)


def _is_candidate(path: Path) -> bool:
    """Tell whether a path is a file that may be a scan. Raises RecordingError for a link that leads nowhere."""
    if path.name.startswith("."):
        return False
    is_data = path.suffix.lower() in CLOUD_READERS or path.suffix.lower() == ".png"
    if is_data and path.is_symlink() and not path.exists():
        raise RecordingError(path, "a link to a file that does not exist", "copy the file, or remove link and pose")
    return path.is_file() and not is_own_output(path)


def _subfolders(folder: Path, depth: bool) -> list[Path]:
    """The one sub-folder with scans, if there is one; several are a choice for the user."""
    places = [p for p in sorted(folder.iterdir()) if p.is_dir() and any(_is_scan(f, depth) for f in p.iterdir())]
    if len(places) > 1:
        names = " ".join(place.name for place in places)
        raise RecordingError(folder, f"scans in several folders: {names}", "give one of them")
    return places


def _is_scan(path: Path, depth: bool) -> bool:
    suffixes = {".png"} if depth else CLOUD_READERS.keys()
    return path.suffix.lower() in suffixes and _is_candidate(path)


def _refuse_unreadable(files: list[Path], depth: bool) -> None:
    """Say what stands in the way where a folder has files and no scan among them."""
    images = [path for path in files if path.suffix.lower() == ".png"]
    if images and not depth:
        raise RecordingError(images[0], "depth images need the camera's intrinsics", "give them with --intrinsics")
    if depth and any(path.suffix.lower() in CLOUD_READERS for path in files):
        raise RecordingError(files[0].parent, "holds clouds, not depth .png", "leave --intrinsics away")
    _refuse_others([], files)


def _refuse_others(scans: list[Path], files: list[Path]) -> None:
    for path in sorted(files):
        if path.suffix.lower() not in BESIDE_SCANS | CLOUD_READERS.keys():
            hint = f"convert it to one of {known_formats()}, or move it away"
            raise RecordingError(path, f"unknown format '{path.suffix}'", hint)
    suffixes = sorted({path.suffix.lower() for path in scans})
    if len(suffixes) > 1:
        raise RecordingError(scans[0].parent, f"holds scans of several formats: {' '.join(suffixes)}", "keep one")


def _natural_key(path: Path) -> list:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.stem)]


def _find_poses(folder: Path) -> Path:
    for place in (folder, folder.resolve().parent):
        for name in POSE_FILES:
            if (place / name).is_file():
                return place / name
    raise RecordingError(folder, f"no pose file ({' or '.join(POSE_FILES)}) in it or beside it", "give it with --poses")


def _assign(files: list[Path], pose_file: Path, poses: Poses) -> tuple[NDArray, NDArray | None, str]:
    """Give each scan its pose: (T, 4, 4), times (T,) [s] or None, and a note where poses are left over."""
    index, note = _index_by_time(files, pose_file, poses.times), ""
    if index is None:
        count = len(poses.T_map_sensor)
        index = _index_by_order(files, pose_file, count)
        if count > len(files):
            numbers = f"{files[0].name} takes line {index[0] + 1}, {files[-1].name} line {index[-1] + 1}"
            note = f"{pose_file}: {count} poses for {len(files)} scans; each takes that of its number: {numbers}"
    return poses.T_map_sensor[index], None if poses.times is None else poses.times[index], note


def _index_by_time(files: list[Path], pose_file: Path, times: NDArray | None) -> NDArray | None:
    """Indices (T,) of the poses nearest in time, or None if names or poses tell no common time."""
    stamps = [_seconds(path.stem) for path in files]
    if times is None or None in stamps:
        return None
    scan_times = np.array(stamps, dtype=np.float64)
    if scan_times.max() < times.min() - 1 or scan_times.min() > times.max() + 1:
        return None  # two clocks
    index = np.array([np.abs(times - t).argmin() for t in scan_times])
    late = np.abs(times[index] - scan_times)
    if late.max() > TIME_TOLERANCE:
        scan, gap = files[int(late.argmax())].name, late.max()
        problem = f"no pose for scan {scan}: the nearest is {gap:.3f} s away, at most {TIME_TOLERANCE} s is allowed"
        raise RecordingError(pose_file, problem, "add its pose or remove the scan")
    return index


def _seconds(stem: str) -> float | None:
    """The time [s] a scan is named by, written in s, ms, us or ns since 1970 or with a decimal point; else None."""
    if not re.fullmatch(r"\d+\.\d+|\d{10,19}", stem):
        return None
    value = float(stem)
    return value / 10 ** (3 * int(max(0, np.floor((np.log10(max(value, 1.0)) - 8) / 3))))


def _index_by_order(files: list[Path], pose_file: Path, count: int) -> NDArray:
    if count == len(files):
        return np.arange(count)
    if count > len(files) and all(path.stem.isdigit() for path in files):
        index = np.array([int(path.stem) for path in files])
        if index.max() < count:
            return index
    scan = f"no pose for scan {files[count].name}: " if count < len(files) else ""
    raise RecordingError(pose_file, f"{scan}{count} poses for {len(files)} scans", "write one line for each scan")


def _steps(files: list[Path], pose_file: Path, times: NDArray | None, dt: float | None) -> NDArray[np.float64]:
    """Time [s] since the scan before, (T,), 0 for the first."""
    if dt is not None or times is None:
        steps = np.full(len(files), 0.1 if dt is None else dt)
    else:
        steps = np.diff(times, prepend=times[:1])
    steps[0] = 0.0
    if (steps < 0).any():
        scan = files[int((steps < 0).argmax())].name
        raise RecordingError(pose_file, f"the pose of scan {scan} is older than that of the scan before it", "sort it")
    if dt is None and times is not None:
        require_plausible_steps(pose_file, steps)
    return steps


def _depth_points(path: Path, camera: Intrinsics) -> NDArray[np.float32]:
    """Points (H * W, 3) [m] of a depth image in the optical frame: x right, y down, z forward."""
    import torch

    from torchelev.clouds import depth_to_points

    depth = read_depth(path, camera.depth_scale)
    check_size(path, camera, depth.shape)
    matrix = torch.from_numpy(camera.matrix).float()
    return depth_to_points(torch.from_numpy(depth)[None], matrix, along=camera.along)[0].numpy()
