"""Where an Icechunk repository lies, how it is opened, and its errors in words."""

from __future__ import annotations

import errno
import functools
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchelev.errors import require
from torchelev.site.ending import rest_at_end
from torchelev.site.storage.interface import InDoubtError

_URL = re.compile(r"s3:/{1,2}([^/]+)(?:/(.*))?")  # a Path has dropped one slash
_MARKS = ("refs", "repo")  # what a folder holds once it is a repository, of Icechunk 1 and 2
_ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL")
_UNCHANGED = "all that was stored before is unchanged"
_KEYS = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
_CAUSES = (  # of a failure: a pattern of its text, the number of the system's error, what it means, and how to fix it
    ("NoSuchBucket", errno.ENOENT, "the bucket does not exist", "make it, or check its name and AWS_ENDPOINT_URL"),
    (
        r"InvalidAccessKeyId|SignatureDoesNotMatch|AccessDenied|Forbidden|ExpiredToken|\b403\b",
        errno.EACCES,
        "the credentials are refused",
        f"set {_KEYS} of a user who may read and write the bucket",
    ),
    ("credential|no providers in chain", errno.EACCES, "there are no credentials", f"set {_KEYS}"),
    (r"No space left|Disk quota|os error (28|122)\b", errno.ENOSPC, "the disk is full", "make room and try again"),
    (r"Read-only file|os error 30\b", errno.EROFS, "the disk is read-only", "choose another folder"),
    (
        r"Permission denied|os error 13\b",
        errno.EACCES,
        "it may not be written",
        "choose a folder that you may write to",
    ),
    (
        "timestamp is invalid|timestamp ordering",
        errno.EINVAL,
        "the clock of this machine, or of one that wrote before, is wrong",
        "set the clocks of all writers, by NTP say, and merge again",
    ),
    ("spec version|newer version", errno.EINVAL, "its Icechunk is newer", "open it on Python 3.12 or later"),
    (
        r"dispatch failure|connect|timed? ?out",
        errno.ECONNREFUSED,
        "the server does not answer",
        "check the network and AWS_ENDPOINT_URL, and try again",
    ),
)


class StoreError(OSError):
    """A repository cannot be read or written. All that was committed before is unchanged."""

    def __init__(self, path: str | Path, error: Exception, rest: str = _UNCHANGED) -> None:
        number, meaning, hint = in_words(error)
        super().__init__(f"{path}: cannot be used ({meaning}); {rest}: {hint}")
        self.errno = number


class RefusedCommitError(StoreError):
    """A commit was refused: nothing of it is stored."""


class UncertainCommitError(StoreError, InDoubtError):
    """The connection ended while a commit was on its way: it may be stored. The next merge finds out."""

    def __init__(self, path: str | Path, error: Exception, commit: str) -> None:
        super().__init__(path, error, "whether the commit is stored shows at the next merge")
        self.commit = commit


def is_url(path: str | Path) -> bool:
    """Return whether a path is that of an object store."""
    return _URL.fullmatch(str(path)) is not None


def normalize(path: str | Path) -> str | Path:
    """Return an absolute folder, or the URL of an object store."""
    found = _URL.fullmatch(str(path))
    return f"s3://{found[1]}/{(found[2] or '').strip('/')}" if found else Path(path).absolute()


def is_repository(path: str | Path) -> bool:
    """Return whether there is an Icechunk repository; OSError if the object store cannot be asked."""
    if not is_url(path):
        return any(Path(path, mark).exists() for mark in _MARKS)
    with errors_in_words(path):
        return bool(import_icechunk().Repository.exists(open_storage(path)))


def is_available() -> bool:
    """Return whether Icechunk is installed."""
    from importlib.util import find_spec

    return find_spec("icechunk") is not None and find_spec("zarr") is not None


def import_icechunk() -> Any:
    """Import icechunk, or raise ModuleNotFoundError that says how to install it."""
    try:
        import icechunk
        import zarr  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name not in ("icechunk", "zarr"):
            raise
        text = f'sites with versions need {error.name}: pip install "torchelev[site]", on Python 3.11 or later'
        raise ModuleNotFoundError(text, name=error.name) from error
    _prepare(icechunk)
    return icechunk


@functools.cache
def _prepare(icechunk: Any) -> None:
    """Quieten Icechunk, and let its threads come to rest before Python ends."""
    icechunk.set_logs_filter("error")  # it warns of several writers of local files, which take turns here
    rest_at_end()


def open_storage(path: str | Path) -> Any:
    """Return the storage of a folder, or of s3://bucket/prefix with what the environment says of it."""
    icechunk = import_icechunk()
    found = _URL.fullmatch(str(path))
    if not found:
        return icechunk.local_filesystem_storage(str(path))
    endpoint = next((os.environ[name] for name in _ENDPOINTS if os.environ.get(name)), None)
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    prefix = (found[2] or "").strip("/")
    require(bool(prefix), "path", "must name a place in the bucket", str(path), f"give s3://{found[1]}/site, say")
    return icechunk.s3_storage(
        bucket=found[1],
        prefix=prefix,
        region=region or ("us-east-1" if endpoint else None),
        endpoint_url=endpoint,
        allow_http=endpoint is not None and endpoint.startswith("http://"),
        force_path_style=endpoint is not None,
        from_env=True,
    )


def configuration() -> Any:
    """Return the settings of a repository.

    One request for a chunk, as splitting those of small ones takes longer. Small caches: by default, 200 merges into a
    site of 11,000 tiles end with 50 MB more.
    """
    icechunk = import_icechunk()
    one = icechunk.StorageConcurrencySettings(
        max_concurrent_requests_for_object=1, ideal_concurrent_request_size=1 << 24
    )
    caching = icechunk.CachingConfig(
        num_snapshot_nodes=1_000,
        num_chunk_refs=100_000,
        num_transaction_changes=0,
        num_bytes_attributes=0,
        num_bytes_chunks=0,
    )
    return icechunk.RepositoryConfig(storage=icechunk.StorageSettings(concurrency=one), caching=caching)


@contextmanager
def errors_in_words(path: str | Path) -> Iterator[None]:
    """Raise Icechunk's errors as a StoreError that says what is wrong and how to fix it."""
    icechunk = import_icechunk()
    try:
        yield
    except (icechunk.ConflictError, icechunk.RebaseFailedError):
        raise
    except icechunk.IcechunkError as error:
        raise StoreError(path, error) from error


def is_in_doubt(error: Exception) -> bool:
    """Return whether a commit that ended with this error may be stored, as the answer may be lost."""
    return in_words(error)[0] in (errno.ECONNREFUSED, errno.EIO)


def in_words(error: Exception) -> tuple[int, str, str]:
    """Return the number of the system's error that is nearest to Icechunk's, what it means, and how to fix it."""
    text = str(error)
    for pattern, number, meaning, hint in _CAUSES:
        if re.search(pattern, text, re.IGNORECASE):
            return number, meaning, hint
    lines = [line.strip(" |`->x") for line in text.splitlines() if line.strip(" |`->x")]
    return errno.EIO, lines[0] if lines else type(error).__name__, "try again"
