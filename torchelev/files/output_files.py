"""Write files completely or not at all: to a temporary file beside the target, which is renamed when complete."""

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

MARK = "torchelev"  # in the header of pictures and meshes that this package writes, to distinguish them from scans
_HEADER_BYTES = 4096  # that hold the mark
_MAP_ARRAYS = ({"resolution", "center", "axes", "config"}, {"header", "corner", "elevation"})  # save_npz, save_map


class WriteError(OSError):
    """A file cannot be written. A file that was there before is unchanged."""

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(f"{path}: cannot be written ({reason}); an older file is left as it was")


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`, and rename it to `path` if the block ends without an error.

    A link is followed: its target is replaced. An older file passes on its permissions.

    Args:
        path: file to write.

    Yields:
        The temporary file, open for writing bytes.

    Raises:
        WriteError: if `path` is a folder or a device, its folder does not exist, or writing fails. The temporary file
            is removed then, and an older file is unchanged.
    """
    with atomic_path(path) as unfinished, unfinished.open("xb") as file:
        yield file


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield the path of a temporary file for a block that writes it by name; otherwise as `atomic_file`."""
    target = _resolve(path)
    unfinished = _name_temporary(target)
    try:
        yield unfinished
        with unfinished.open("r+b") as file:
            os.fsync(file.fileno())  # some file systems report a full disk only here
        if target.exists():
            unfinished.chmod(stat.S_IMODE(target.stat().st_mode))
        os.replace(unfinished, target)
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(path, _describe(error)) from error
    finally:
        _remove(unfinished)


def require_writable(path: str | Path, num_bytes: int = 0) -> None:
    """Raise WriteError if a file of `num_bytes` cannot be written to `path`. Leaves no file behind."""
    target = _resolve(path)
    probe = _name_temporary(target)
    try:
        probe.touch(exist_ok=False)
        free = shutil.disk_usage(target.parent).free
    except OSError as error:
        raise WriteError(path, _describe(error)) from error
    finally:
        _remove(probe)
    limits = {"the disk has": free, "the size limit of files (ulimit -f) is": get_size_limit()}
    for what, limit in limits.items():
        if limit is not None and limit < num_bytes:
            need = f"up to {num_bytes / 1e6:.3g} MB are needed"
            raise WriteError(path, f"{what} {limit / 1e6:.3g} MB, {need}: make room, or map fewer cells")


def is_own_output(path: Path) -> bool:
    """Return whether this package wrote a file: a picture, mesh or map beside scans is not a scan."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                names = {name.removesuffix(".npy") for name in archive.namelist()}
            return any(arrays <= names for arrays in _MAP_ARRAYS)
        if suffix in (".ply", ".png"):
            with path.open("rb") as file:
                return MARK.encode() in file.read(_HEADER_BYTES)
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        pass  # its reader raises an error that explains it
    return False


def _resolve(path: str | Path) -> Path:
    """Follow the links of `path` to a regular file, or to where none is yet."""
    try:
        target = Path(os.path.realpath(path))
        kind = target.stat().st_mode
    except FileNotFoundError:
        if not target.parent.is_dir():
            raise WriteError(path, f"there is no folder {target.parent}: make it first") from None
        return target
    except OSError as error:
        raise WriteError(path, _describe(error)) from error
    if stat.S_ISDIR(kind):
        raise WriteError(path, "it is a folder")
    if not stat.S_ISREG(kind):
        raise WriteError(path, "it is a device or a pipe, not a file")
    return target


def _name_temporary(target: Path) -> Path:
    return target.with_name(f".{uuid4().hex}.tmp")  # short: the target's name may have the maximum length


def _remove(path: Path) -> None:
    with suppress(OSError):  # a read-only disk raises even if there is no such file
        path.unlink()


def _describe(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__


def get_size_limit() -> int | None:
    """Return the largest file [bytes] that this process may write; None: no limit."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return None if limit == resource.RLIM_INFINITY else limit
