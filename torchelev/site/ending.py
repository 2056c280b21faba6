"""The end of a process whose threads of other libraries may still be at work."""

import atexit
import functools
import time

_REST = 0.1  # [s]


@functools.cache
def rest_at_end() -> None:
    """Let threads hand over their last results before Python ends: one that then waits for it aborts the process.

    Icechunk's threads do, and those of Gloo, which give back the tensors of a collective after it has returned.
    """
    atexit.register(time.sleep, _REST)
