"""A function run in another process, so that two can compile at a time: Python code runs on one core."""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_RUN = """
import pickle, sys
sys.path[:] = pickle.load(sys.stdin.buffer)
function, arguments = pickle.load(sys.stdin.buffer)
function(*arguments)
"""
_started: list[subprocess.Popen[bytes]] = []


def run_elsewhere(function: Callable[..., Any], *arguments: Any) -> subprocess.Popen[bytes] | None:
    """Start a module's function in a new Python process; its output is discarded.

    Args:
        function: of a module that can be imported.
        arguments: a few kilobytes, or the process must have read them before this returns.

    Returns:
        The process; None if the arguments cannot be sent, or no Python process can be started.
    """
    if not Path(sys.executable or "").name.startswith("python"):  # in a program that embeds Python it is that program
        return None
    try:
        order = pickle.dumps(sys.path) + pickle.dumps((function, arguments))
        process = subprocess.Popen(
            [sys.executable, "-c", _RUN],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    except (OSError, pickle.PicklingError, AttributeError, TypeError):  # the latter two: what has no name, or no copy
        return None
    _started[:] = [other for other in _started if other.poll() is None]  # which also ends those that are done
    _started.append(process)
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin as pipe:
        pipe.write(order)
    return process
