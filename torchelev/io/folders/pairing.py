"""Which scan of a folder takes which pose of a file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError
from torchelev.io.files.layout import require_plausible_steps
from torchelev.io.folders.scan_files import parse_stamp
from torchelev.io.poses import Poses

_TIME_TOLERANCE = 0.02  # [s] between a scan's timestamp and its pose's, as in TUM's own tools
_FEW = 2  # poses more than scans that are numbered on from 0: which of them have no scan is ambiguous
_ONE_LINE = "write one line for each scan, or name the scans by the times of their poses"


class Pairing(NamedTuple):
    """The pose of each scan, and when it was taken."""

    poses: NDArray[np.int64]  #: (T,) indices in the pose file
    stamps: NDArray[np.float64] | None  #: (T,) [s] of the scans, by the poses' clock; None: unknown
    notes: tuple[str, ...] = ()  #: what is doubtful


def pair(files: list[Path], pose_file: Path, poses: Poses) -> Pairing:
    """Find the pose of each scan.

    If the scans' names are times of the poses' clock, each takes the pose nearest in time, within 20 ms. Otherwise they
    are paired in order; if there are more poses than scans, numbered scans take the pose of their number.

    Raises:
        RecordingError: a scan has no pose, or its pose is ambiguous.
    """
    names = [parse_stamp(path.stem) for path in files]
    named = None if None in names else np.array(names, dtype=np.float64)
    if named is None or poses.times is None:
        index, notes = _match_order(files, pose_file, len(poses.T_map_sensor))
        return Pairing(index, named if poses.times is None else poses.times[index], notes)
    if _overlap(named, poses.times):
        return Pairing(_match_times(files, pose_file, named, poses.times), named)
    ranges = f"the names of scans are times from {_span(named)}, the poses have {_span(poses.times)}"
    if len(files) != len(poses.times):
        raise RecordingError(pose_file, f"the clocks differ: {ranges}", "give times of one clock, or as many poses")
    return Pairing(
        np.arange(len(files)),
        poses.times,
        (f"{pose_file}: the clocks differ: {ranges}; scans and poses are paired in order",),
    )


def compute_steps(files: list[Path], pose_file: Path, times: NDArray | None, dt: float | None) -> NDArray[np.float64]:
    """Return the times since the previous scan (T,) [s], 0 for the first.

    Args:
        files: T scans.
        pose_file: for messages.
        times: (T,) [s] of the scans; None: unknown.
        dt: [s] between scans, which takes precedence; None: from `times`, or 0.1.

    Raises:
        RecordingError: the times decrease, or no sensor has such.
    """
    if dt is not None or times is None:
        steps = np.full(len(files), 0.1 if dt is None else dt)
    else:
        steps = np.diff(times, prepend=times[:1])
    steps[0] = 0.0
    if (steps < 0).any():
        name = files[int((steps < 0).argmax())].name
        raise RecordingError(pose_file, f"the pose of scan {name} is older than that of the scan before it", "sort it")
    if dt is None and times is not None:
        require_plausible_steps(pose_file, steps)
    return steps


def _overlap(named: NDArray, times: NDArray) -> bool:
    return bool(named.max() >= times.min() - 1 and named.min() <= times.max() + 1)


def _span(times: NDArray) -> str:
    return f"{times.min():.14g} to {times.max():.14g} s"


def _match_times(files: list[Path], pose_file: Path, named: NDArray, times: NDArray) -> NDArray:
    """Return the indices (T,) of the poses nearest in time."""
    index = np.array([np.abs(times - t).argmin() for t in named])
    gaps = np.abs(times[index] - named)
    if gaps.max() > _TIME_TOLERANCE:
        name, gap = files[int(gaps.argmax())].name, gaps.max()
        problem = f"no pose for scan {name}: the nearest is {gap:.3f} s away, at most {_TIME_TOLERANCE} s is allowed"
        raise RecordingError(pose_file, problem, "add its pose or remove the scan")
    return index


def _match_order(files: list[Path], pose_file: Path, num_poses: int) -> tuple[NDArray, tuple[str, ...]]:
    """Return the indices (T,) of poses in the scans' order, or by the scans' numbers if there are more poses."""
    if num_poses == len(files):
        return np.arange(num_poses), ()
    counts = f"{num_poses} poses for {len(files)} scans"
    index = np.array([int(path.stem) if path.stem.isdigit() else num_poses for path in files])
    if num_poses < len(files) or index.max() >= num_poses:
        scan = f"no pose for scan {files[num_poses].name}: " if num_poses < len(files) else ""
        raise RecordingError(pose_file, f"{scan}{counts}", _ONE_LINE)
    is_whole = len(files) > 1 and bool((np.diff(index) == 1).all()) and index[0] <= 1
    if is_whole and (index[0] == 1 or num_poses - len(files) <= _FEW):
        open_line = f"which line belongs to {files[0].name} is ambiguous"
        raise RecordingError(pose_file, f"{counts}: {open_line}", _ONE_LINE)
    lines = f"{files[0].name} takes line {index[0] + 1}, {files[-1].name} line {index[-1] + 1}"
    return index, (f"{pose_file}: {counts}; each scan takes that of its number: {lines}",)
