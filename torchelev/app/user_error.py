"""Errors of the user and warnings: one line each on stderr, without a traceback or a line of source."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import click

from torchelev.io.errors import RecordingError

BAD_INPUT, EMPTY_MAP = 2, 3  # exit codes
# The extra of torchelev that installs a package.
_EXTRAS = {
    "rosbags": "bags", "mcap": "bags", "av": "video", "viser": "view", "trimesh": "view", "tensorstore": "site",
    "icechunk": "site", "zarr": "site", "zenoh": "serve",
    "kiss_icp": "odometry", "onnxruntime": "deploy", "tifffile": "geo", "rasterio": "geo",
}  # fmt: skip


class UserError(click.ClickException):
    """Bad input: print one line to stderr and exit with code 2."""

    exit_code = BAD_INPUT

    def __init__(self, error: object) -> None:
        text = str(error)
        if isinstance(error, OSError) and error.filename is not None and error.strerror:
            text = f"{error.filename}: {error.strerror.lower()}"  # instead of "[Errno 2] ..."
        super().__init__(" ".join(text.split()))


class EmptyMapError(click.ClickException):
    """An empty or nearly empty map: print one line to stderr and exit with code 3."""

    exit_code = EMPTY_MAP


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Print each different warning of the block as one line on stderr."""
    seen: set[str] = set()

    def show(message: Warning | str, *_: object, **__: object) -> None:
        text = " ".join(str(message).split())
        if text not in seen:
            seen.add(text)
            click.echo(f"warning: {text}", err=True)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn exceptions of bad input and missing packages in the block into one-line errors."""
    try:
        yield
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get(str(error.name).split(".")[0], "io")
        raise UserError(f"{error}; install it with pip install 'torchelev[{extra}]'") from error
    except BrokenPipeError:  # of `| head`: click ends quietly
        raise
    except KeyError as error:  # whose text is its argument's repr
        raise UserError(error.args[0] if error.args else error) from error
    except (RecordingError, ValueError, OSError) as error:
        raise UserError(error) from error
