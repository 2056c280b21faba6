"""Find the scans of a recording: which files in which folder, in which order."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from torchelev.io.errors import RecordingError
from torchelev.io.folders.clouds import CLOUD_SUFFIXES
from torchelev.output_files import is_own_output

# Files of these types may lie beside point clouds; any other file there is an error, not silently skipped.
_IGNORED_SUFFIXES = {"", *".txt .csv .json .yaml .yml .md .log .png .jpg .jpeg .mp4 .gif .bag .mcap .db3".split()}
_SCANS_FOLDER = "scans"  # takes precedence over scans beside it


def find_scans(folder: Path, depth: bool = False) -> list[Path]:
    """Find the scans in `folder`/scans, in `folder` or in its only subfolder that has some.

    Args:
        folder: of the recording.
        depth: look for depth images, not for point clouds.

    Returns:
        The files in natural order: 2 before 10.

    Raises:
        RecordingError: there are no scans, several folders or formats of them, or files that cannot be read.
    """
    if not folder.is_dir():
        problem = "is a file, not a folder" if folder.exists() else "no such file or folder"
        raise RecordingError(folder, problem, "give the folder that holds the scans")
    for place in _list_places(folder, depth):
        files = [path for path in place.iterdir() if _is_input(path)]
        scans = [path for path in files if _is_scan(path, depth)]
        if scans:
            if not depth:
                _require_known_formats(files)
            _require_one_format(scans)
            return sorted(scans, key=_natural_key)
        if place == folder:
            _explain_missing_scans(files, depth)
    wanted = "depth .png" if depth else " ".join(CLOUD_SUFFIXES)
    found = sorted({path.suffix or path.name for path in folder.rglob("*") if path.is_file()})
    problem = f"holds no scan, only {' '.join(found[:8])}" if found else "holds no scan"
    raise RecordingError(folder, problem, f"expected files of one format among {wanted}")


def has_clouds(folder: Path) -> bool:
    """Tell whether a folder or its subfolder `scans` holds point clouds."""
    return any(_has_scan(place, depth=False) for place in (folder, folder / _SCANS_FOLDER))


def _list_places(folder: Path, depth: bool) -> Iterator[Path]:
    """Yield the folders that may hold the scans, by precedence."""
    scans = folder / _SCANS_FOLDER
    if _has_scan(scans, depth):
        yield scans
    yield folder
    subfolders = [path for path in sorted(folder.iterdir()) if _has_scan(path, depth)]
    if len(subfolders) > 1:
        names = " ".join(path.name for path in subfolders)
        raise RecordingError(folder, f"scans in several folders: {names}", "give one of them")
    yield from subfolders


def _has_scan(folder: Path, depth: bool) -> bool:
    return folder.is_dir() and any(_is_scan(path, depth) for path in folder.iterdir())


def _is_scan(path: Path, depth: bool) -> bool:
    suffixes = (".png",) if depth else CLOUD_SUFFIXES
    return path.suffix.lower() in suffixes and _is_input(path)


def _is_input(path: Path) -> bool:
    """Tell whether a path is a visible file that torchelev did not write; raise RecordingError for a broken link."""
    if path.name.startswith("."):
        return False
    if path.suffix.lower() in (*CLOUD_SUFFIXES, ".png") and path.is_symlink() and not path.exists():
        raise RecordingError(path, "a link to a file that does not exist", "copy the file, or remove link and pose")
    return path.is_file() and not is_own_output(path)


def _require_one_format(scans: list[Path]) -> None:
    suffixes = sorted({path.suffix.lower() for path in scans})
    if len(suffixes) > 1:
        raise RecordingError(scans[0].parent, f"holds scans of several formats: {' '.join(suffixes)}", "keep one")


def _require_known_formats(files: list[Path]) -> None:
    for path in sorted(files):
        if path.suffix.lower() not in (*CLOUD_SUFFIXES, *_IGNORED_SUFFIXES):
            hint = f"convert it to one of {' '.join(CLOUD_SUFFIXES)}, or move it away"
            raise RecordingError(path, f"unknown format '{path.suffix}'", hint)


def _explain_missing_scans(files: list[Path], depth: bool) -> None:
    """Raise RecordingError if the files of a folder without scans show what went wrong."""
    images = [path for path in files if path.suffix.lower() == ".png"]
    if images and not depth:
        raise RecordingError(images[0], "depth images need the camera's intrinsics", "give them with --intrinsics")
    if depth and any(path.suffix.lower() in CLOUD_SUFFIXES for path in files):
        raise RecordingError(files[0].parent, "holds point clouds, not depth .png", "drop --intrinsics")
    _require_known_formats(files)


def _natural_key(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.stem)]
