"""Write files whole or not at all: into a temporary file beside the target, which is renamed when it is complete."""

from __future__ import annotations

import os
import shutil
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

MARK = "torchelev"  # in the head of the pictures and meshes that are written, so that they are not taken for scans
HEAD = 4096  # [bytes] within which the mark stands
MAP_ARRAYS = ({"resolution", "center", "axes", "config"}, {"header", "corner", "elevation"})  # save_npz, save_map


class WriteError(OSError):
    """A file cannot be written; one that was there before is as it was."""

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(f"{path}: cannot be written ({reason}); an older file is left as it was")


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`, and rename it to `path` when the block has ended without an error.

    A link stays a link, and its target is replaced. An older file passes on its permissions.

    Raises WriteError if `path` is a folder or a device, and if writing fails; the older file is whole then, and the
    temporary one is removed.
    """
    target = _target(path)
    unfinished = _temporary(target)
    try:
        with unfinished.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # some file systems tell only now that the disk is full
        if target.exists():
            unfinished.chmod(stat.S_IMODE(target.stat().st_mode))
        os.replace(unfinished, target)
    except OSError as error:
        raise WriteError(path, _reason(error)) from error
    finally:
        _remove(unfinished)


def require_writable(path: str | Path, num_bytes: int = 0) -> None:
    """Raise WriteError if a file of `num_bytes` could not be written to `path`; leaves the folder as it was."""
    target = _target(path)
    probe = _temporary(target)
    try:
        probe.touch(exist_ok=False)
        free = shutil.disk_usage(target.parent).free
    except OSError as error:
        raise WriteError(path, _reason(error)) from error
    finally:
        _remove(probe)
    limits = {"the disk has": free, "the size limit of files (ulimit -f) is": _size_limit()}
    for what, limit in limits.items():
        if limit is not None and limit < num_bytes:
            need = f"up to {num_bytes / 1e6:.3g} MB are needed"
            raise WriteError(path, f"{what} {limit / 1e6:.3g} MB, {need}: make room, or map fewer cells")


def is_own_output(path: Path) -> bool:
    """Tell whether this package wrote a picture, a mesh or a map: outputs that lie beside scans are none."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                names = {name.removesuffix(".npy") for name in archive.namelist()}
            return any(arrays <= names for arrays in MAP_ARRAYS)
        if suffix in (".ply", ".png"):
            with path.open("rb") as file:
                return MARK.encode() in file.read(HEAD)
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        pass  # whoever reads it says what is wrong with it
    return False


def _target(path: str | Path) -> Path:
    """Return where the links of `path` lead, which is a regular file or nothing yet."""
    try:
        target = Path(os.path.realpath(path))
        kind = target.stat().st_mode
    except FileNotFoundError:
        return target
    except OSError as error:
        raise WriteError(path, _reason(error)) from error
    if stat.S_ISDIR(kind):
        raise WriteError(path, "it is a folder")
    if not stat.S_ISREG(kind):
        raise WriteError(path, "it is a device or a pipe, not a file")
    return target


def _temporary(target: Path) -> Path:
    return target.with_name(f".{uuid4().hex}.tmp")  # short: the target's name may be as long as names can be


def _remove(path: Path) -> None:
    with suppress(OSError):  # also raised for a file that is not there if the disk is read-only
        path.unlink()


def _reason(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__


def _size_limit() -> int | None:
    """Return the largest size [bytes] of a file that this process may write, None if there is no limit."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return None if limit == resource.RLIM_INFINITY else limit
