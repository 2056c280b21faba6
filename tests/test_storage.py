"""Memory that an update frees is kept for the next one."""

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys, torch
from torchelev.storage import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
for k in range(30):
    if k == 10:  # the first rounds take the memory from the system
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    layers = [torch.ones(2**20) for _ in range(4)]
    del layers
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators keep memory by rules of their own")
def test_freed_memory_is_kept():
    keep, leave = (
        int(subprocess.run([sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=True).stdout)
        for how in ("keep", "leave")
    )
    assert keep < 500 and leave > 20_000, (keep, leave)
