"""Processes forked after the parent has used maps: they lack its threads.

OpenMP would wait for these forever. Such a child computes on one thread, as the workers of torch's own DataLoader do.
"""

from __future__ import annotations

import functools
import os
import warnings

import torch

_lost_threads = 0  # of the parent, in a forked child that has not warned yet


@functools.cache
def survive_forks() -> None:
    """Let children that are forked from now on compute on one thread; called when a map is made."""
    if hasattr(os, "register_at_fork"):  # not on Windows, which cannot fork
        os.register_at_fork(after_in_child=_use_one_thread)


def _use_one_thread() -> None:
    global _lost_threads
    threads = torch.get_num_threads()
    if threads > 1:
        torch.set_num_threads(1)
        _lost_threads = threads


def warn_of_fork() -> None:
    """Warn, once in a forked child, that it computes on one thread, and how to start workers with all threads."""
    global _lost_threads
    if not _lost_threads:
        return
    threads, _lost_threads = _lost_threads, 0
    warnings.warn(
        f"this process was forked from one that had used maps, and has none of its {threads} threads: it computes on "
        "one. Start workers by "
        '"spawn" or "forkserver", such as AsyncVectorEnv(..., context="spawn"), or make no map before they are forked.',
        RuntimeWarning,
        stacklevel=4,
    )
