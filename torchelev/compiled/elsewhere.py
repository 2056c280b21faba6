"""A function run in another process, so that two can compile at a time: Python code runs on one core."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_RUN = "import pickle, sys; function, arguments = pickle.load(sys.stdin.buffer); function(*arguments)"
_PACKAGES = Path(__file__).parents[2]  # where torchelev lies


def run_elsewhere(function: Callable[..., Any], *arguments: Any) -> subprocess.Popen[bytes] | None:
    """Start a module's function in a new process, which says nothing and returns nothing.

    Returns:
        The process; None if the arguments cannot be sent, or no process be started.
    """
    path = os.pathsep.join([str(_PACKAGES), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        order = pickle.dumps((function, arguments))
        process = subprocess.Popen(
            [sys.executable, "-c", _RUN],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": path},
        )
    except (OSError, pickle.PicklingError, AttributeError, TypeError):  # the latter two: what has no name, or no copy
        return None
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin as pipe:
        pipe.write(order)
    return process
