"""The files that `torchelev map` writes: checked before mapping, written after it, if need be to a fallback folder."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchelev.files.output_files import require_writable
from torchelev.io import MappingRun

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

_SUFFIXES = (".npz", ".png", ".ply")
_MESH_BYTES = 50  # per cell of a `.ply`: one vertex of 24 bytes, two triangles of 13 bytes each


def prepare_outputs(out: str, emap: ElevationMap) -> Path:
    """Check before mapping that the map can be written, and create its folder.

    Args:
        out: a prefix, with or without the suffix of an output file, or a folder, where files are named `map`.
        emap: the map to write later; its size sets the disk space needed.

    Returns:
        The prefix of the files.

    Raises:
        ValueError: the folder cannot be created, or `out` is a device or a pipe.
        WriteError: a file cannot be written there, or the disk is too full.
    """
    import matplotlib  # noqa: F401  # fail now if a package needed for writing is missing
    import plyfile  # noqa: F401

    path = Path(out)
    prefix = path / "map" if path.is_dir() or out.endswith(("/", "\\")) else path
    prefix = prefix.with_suffix("") if prefix.suffix in _SUFFIXES else prefix
    try:
        prefix.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {out}: cannot create the folder {prefix.parent} ({error.strerror})") from error
    if prefix.exists() and not prefix.is_file():
        raise ValueError(f"--out {out}: must not be a device or a pipe; give a folder or a file prefix")
    num_cells = emap.cfg.grid.height * emap.cfg.grid.width
    # The `.npz` holds the state, too; both compressed take less than the layers do uncompressed.
    for path, bytes_per_cell in zip(_add_suffixes(prefix), (4 * len(emap.layers), 0, _MESH_BYTES), strict=True):
        require_writable(path, bytes_per_cell * num_cells)
    return prefix


def write_outputs(run: MappingRun, prefix: Path) -> tuple[list[Path], list[str]]:
    """Write the map as `.npz`, `.png` and `.ply`; a file that cannot be written there goes to another folder.

    Args:
        run: the map and the sensor's path.
        prefix: of the files.

    Returns:
        The files written, and one line for each failure.
    """
    from torchelev.io import export

    writers: tuple[Callable[[Path], object], ...] = (
        lambda path: export.save_npz(path, run.emap),
        lambda path: _save_picture(path, run, prefix.name),
        lambda path: export.save_mesh(path, run.emap),
    )
    files, failures = [], []
    for path, write in zip(_add_suffixes(prefix), writers, strict=True):
        try:
            write(path)
            files.append(path)
        except (OSError, ModuleNotFoundError) as error:  # go on: the other files may still be written
            kept = _write_to_fallback(path.name, write) if isinstance(error, OSError) else None
            files += [] if kept is None else [kept]
            failures.append(f"{error}; " + ("not kept" if kept is None else f"kept in {kept}"))
    return files, failures


def _add_suffixes(prefix: Path) -> list[Path]:
    return [prefix.with_name(prefix.name + suffix) for suffix in _SUFFIXES]


def _write_to_fallback(name: str, write: Callable[[Path], object]) -> Path | None:
    """Write a file to the first fallback folder that accepts it; return its path, or None if none does."""
    for base in (Path(tempfile.gettempdir()), Path.cwd(), Path.home(), Path("/dev/shm")):
        try:
            folder = Path(tempfile.mkdtemp(prefix="torchelev-", dir=base))
        except OSError:
            continue
        try:
            write(folder / name)
            return folder / name
        except OSError:
            folder.rmdir()
    return None


def _save_picture(path: Path, run: MappingRun, title: str) -> None:
    """Draw the main layers, those of filters, and the sensor's path."""
    from torchelev.io.export import take
    from torchelev.viz.map_picture import choose_panels
    from torchelev.viz.plot import save_layers

    saved = take(run.emap)
    panels = choose_panels(saved, tuple(step.layer for step in run.emap.cfg.filters))
    save_layers(path, panels, extent=saved.extent, path_xy=np.array(run.sensor_xy), title=title)
