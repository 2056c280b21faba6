"""Write many files of a folder all or nothing: a killed process loses only the transaction in progress."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from torchelev.errors import message

LOCK, STAGED, COMMITTED = ".lock", ".staged", ".committed"

_FULL, _FORBIDDEN = "make room and try again", "choose a folder that you may write to"
_HINTS = {errno.ENOSPC: _FULL, errno.EDQUOT: _FULL, errno.EACCES: _FORBIDDEN, errno.EROFS: _FORBIDDEN}
T = TypeVar("T")


class CommitError(OSError):
    """A commit failed. Everything stored before is unchanged, and the store remains usable."""

    def __init__(self, path: Path, error: OSError) -> None:
        hint = _HINTS.get(error.errno or 0, "try again")
        reason = error.strerror or str(error) or type(error).__name__
        super().__init__(f"{path}: cannot be written ({reason}); all that was stored before is unchanged: {hint}")
        self.errno = error.errno


def lock_folder(path: Path) -> FileLock:
    """Become the only writer of a folder; the operating system releases the lock of a process that ends.

    Raises:
        OSError: another writer has it open, or it cannot be written.
    """
    lock = FileLock(path / LOCK, timeout=0, thread_local=False)  # any thread may release it
    try:
        lock.acquire()
    except Timeout as error:
        hint = "close the other one, or read beside it with SiteMap.open(path, read_only=True)"
        raise OSError(message(str(path), "expected one writer at a time", "a second one", hint)) from error
    except OSError as error:
        reason = error.strerror or str(error)
        text = message(str(path), "must be writable", reason, "read it with SiteMap.open(path, read_only=True)")
        raise type(error)(error.errno, text) from error
    return lock


@contextmanager
def stage(path: Path) -> Iterator[Path]:
    """Commit the files that the block writes, if it ends without an error; `finish` then moves them into place.

    Args:
        path: folder that the files belong to.

    Yields:
        An empty folder; a file's path in it is the one that it gets in `path`.

    Raises:
        CommitError: writing failed; what the block wrote is removed.
    """
    folder = path / STAGED
    try:
        discard(path)
        folder.mkdir()
        yield folder
        os.rename(folder, path / COMMITTED)
    except BaseException as error:
        with suppress(OSError):
            discard(path)
        if isinstance(error, OSError):
            raise CommitError(path, error) from error
        raise


def finish(path: Path) -> bool:
    """Move the files of a committed transaction into place, continuing an interrupted call.

    Metadata follow what they describe, and those of the folder itself come last.

    Returns:
        Whether there was a transaction.
    """
    source = path / COMMITTED
    if not source.is_dir():
        return False
    files = [os.path.join(folder, name) for folder, _, names in os.walk(source) for name in names]
    for file in sorted(files, key=lambda file: (file.endswith(".json"), -file.count(os.sep))):
        _move(file, os.path.join(path, os.path.relpath(file, source)))
    shutil.rmtree(source)
    return True


def clean(path: Path) -> bool:
    """Remove what an earlier writer staged, and complete what it committed; return whether it committed anything.

    Raises:
        CommitError: the folder cannot be written.
    """
    try:
        discard(path)
        return finish(path)
    except OSError as error:
        raise CommitError(path, error) from error


def read_newest(path: Path, read: Callable[[Path], T]) -> T:
    """Return the result of `read` on the files of the last commit, including those not yet moved.

    Args:
        path: folder that the files belong to.
        read: function of the folder to read from; raises FileNotFoundError if its file is not there.
    """
    try:
        return read(path / COMMITTED)
    except FileNotFoundError:  # files move from the one folder to the other, never back
        return read(path)


def discard(path: Path) -> None:
    """Remove the files of a transaction that was not committed."""
    if (path / STAGED).exists():
        shutil.rmtree(path / STAGED)


def _move(file: str, target: str) -> None:
    try:
        os.replace(file, target)
    except FileNotFoundError:
        os.makedirs(os.path.dirname(target), exist_ok=True)
        os.replace(file, target)
