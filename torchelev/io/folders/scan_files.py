"""Find the scans of a recording: which files in which folder, in which order."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from torchelev.files.output_files import is_own_output
from torchelev.io.errors import RecordingError
from torchelev.io.files.clouds import CLOUD_SUFFIXES

# Files of these types may lie beside point clouds; any other file there is an error, not silently skipped.
_IGNORED_SUFFIXES = {"", *".txt .csv .json .yaml .yml .md .log .png .jpg .jpeg .mp4 .gif .bag .mcap .db3".split()}
DEPTH_SUFFIXES = (".png", ".npy", ".npz")
_MAX_SENSORS = 4  # more words in names are those of scans, such as checksums
_SINCE_1970 = 1e9, 4.2e9  # [s] the years 2001 to 2103
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # [s]
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
        problem = "is neither a folder of scans nor a bag (.bag, .mcap, .db3)"
        problem = problem if folder.exists() else "no such file or folder"
        raise RecordingError(folder, problem, "give the folder that holds the scans")
    for place in _list_places(folder, depth):
        files = [path for path in place.iterdir() if _is_input(path)]
        scans = [path for path in files if _is_scan(path, depth)]
        if depth:
            scans = _choose_depth(scans)
        if scans:
            if not depth:
                _require_known_formats(files)
            _require_one_format(scans)
            _require_one_sensor(scans)
            return _sort(scans)
        if place == folder:
            _explain_missing_scans(files, depth)
    wanted = " ".join(DEPTH_SUFFIXES if depth else CLOUD_SUFFIXES)
    found = sorted({path.suffix or path.name for path in folder.rglob("*") if path.is_file()})
    problem = f"holds no scan, only {' '.join(found[:8])}" if found else "holds no scan"
    raise RecordingError(folder, problem, f"expected files of one format among {wanted}")


def has_clouds(folder: Path) -> bool:
    """Return whether a folder or its subfolder `scans` holds point clouds."""
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
    suffixes = DEPTH_SUFFIXES if depth else CLOUD_SUFFIXES
    return path.suffix.lower() in suffixes and _is_input(path)


def _is_input(path: Path) -> bool:
    """Return whether a path is a visible file that torchelev did not write; raise RecordingError for a broken link."""
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
    """Raise RecordingError if a folder without scans holds files that show the mistake."""
    images = [path for path in files if path.suffix.lower() == ".png"]
    if images and not depth:
        raise RecordingError(images[0], "depth images need the camera's intrinsics", "give them with --intrinsics")
    if depth and any(path.suffix.lower() in CLOUD_SUFFIXES for path in files):
        raise RecordingError(files[0].parent, "holds point clouds, not depth images", "drop --intrinsics")
    _require_known_formats(files)


def _choose_depth(scans: list[Path]) -> list[Path]:
    """Return the files that a simulator or camera names depth, if there are others beside them; else images first."""
    kinds = _sort_by_kind(scans)
    named = [kind for kind in kinds if re.search("depth|distance to", kind)]
    return kinds[named[0]] if len(named) == 1 else [path for path in scans if path.suffix.lower() == ".png"] or scans


def _require_one_sensor(scans: list[Path]) -> None:
    """Refuse files with different naming patterns, as from two sensors."""
    kinds = _sort_by_kind(scans)
    if 1 < len(kinds) <= _MAX_SENSORS and min(map(len, kinds.values())) > 1:
        examples = ", ".join(f"{paths[0].name} and {len(paths) - 1} more" for paths in kinds.values())
        problem = f"holds scans of several names, as of several sensors: {examples}"
        raise RecordingError(scans[0].parent, problem, "give a folder with those of one")


def _sort_by_kind(scans: list[Path]) -> dict[str, list[Path]]:
    """Return the files by the words in their names, without numbers."""
    kinds: dict[str, list[Path]] = {}
    for path in sorted(scans, key=_natural_key):
        kinds.setdefault(" ".join(re.findall("[^\\W\\d_]+", path.stem.lower())), []).append(path)
    return kinds


def _sort(scans: list[Path]) -> list[Path]:
    """Return the files by the times that are their names, or by the numbers in them."""
    stamps = {path: parse_stamp(path.stem) for path in scans}
    if None in stamps.values():
        return sorted(scans, key=_natural_key)
    return sorted(scans, key=lambda path: (stamps[path], path.name))


def parse_stamp(stem: str) -> float | None:
    """Return the time [s] in a file's name; None if there is none.

    That is a decimal number, or at the end of the name s, ms, us or ns since 1970, or s and ns: 1700000000_123456789.
    Numbers with leading zeros count scans.
    """
    stem = stem.removesuffix(".pcd")  # nuScenes: .pcd.bin
    if re.fullmatch(r"\d{1,8}\.\d+", stem):
        return float(stem)
    match = re.fullmatch(r"(?:.*[^\d.])?(?:(\d{10})[_-](\d{9})|([1-9]\d{9,18}(?:\.\d+)?))", stem)
    if match is None:
        return None
    value = float(match[1]) + 1e-9 * float(match[2]) if match[1] else float(match[3])
    return next((value * unit for unit in _UNITS if _SINCE_1970[0] <= value * unit < _SINCE_1970[1]), None)


def _natural_key(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.stem)]
