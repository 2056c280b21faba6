"""How long it takes to import torchelev and to run the first update."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from typing import Any

import torch

from benchmarks.speed.common.meter import progress

_IMPORT = "import time, torch; t = time.perf_counter(); import torchelev; print(time.perf_counter() - t)"
# Imports nothing that a user's program does not, as its memory is measured, too.
_FIRST_UPDATE = """
import time, torch
from benchmarks.speed.common.workload import BPEARL, Drive, full_config
torch.set_num_threads({threads})
drive = Drive(full_config(), BPEARL, scans=1)
t = time.perf_counter()
drive()
seconds = time.perf_counter() - t
print(seconds, next(1024e-6 * int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


def start(seconds: float) -> dict[str, Any]:
    """Time the import and the first update, with an empty and a filled cache of libraries, in new processes."""
    imports = [float(_run_python(_IMPORT)[0]) for _ in progress(range(5), "start")]
    first = _FIRST_UPDATE.format(threads=torch.get_num_threads())
    with tempfile.TemporaryDirectory() as cache:
        runs = [_run_python(first, TORCHELEV_CACHE=cache) for _ in progress(range(2), "start")]
    (cold, messages), (cached, _) = runs
    result: dict[str, Any] = {"import_seconds": statistics.median(imports)}
    for name, numbers in (("", cold), ("cached_", cached)):
        seconds_taken, megabytes = map(float, numbers.split())
        result |= {f"{name}first_update_seconds": seconds_taken, f"{name}megabytes": megabytes}
    return result | {"announced": messages.count("torchelev: building")}


def _run_python(code: str, **environment: str) -> tuple[str, str]:
    """Run code in a new process; return its stdout and stderr."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ | environment
    )
    return done.stdout.strip(), done.stderr
