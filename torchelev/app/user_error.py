"""Errors of the user: one line on stderr and exit code 2, without a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import click

from torchelev.io.errors import RecordingError

BAD_INPUT = 2  # exit code
# The extra of torchelev that installs a package.
_EXTRAS = {
    "rosbags": "bags", "mcap": "bags", "av": "video", "viser": "view", "trimesh": "view", "tensorstore": "site",
    "kiss_icp": "odometry",
}  # fmt: skip


class UserError(click.ClickException):
    """Bad input: print one line to stderr and exit with code 2."""

    exit_code = BAD_INPUT

    def __init__(self, error: object) -> None:
        super().__init__(" ".join(str(error).split()))


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn what bad input and missing packages raise in the block into errors of one line."""
    try:
        yield
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get(str(error.name).split(".")[0], "io")
        raise UserError(f"{error}; install it with pip install 'torchelev[{extra}]'") from error
    except (RecordingError, ValueError, OSError) as error:
        raise UserError(error) from error
