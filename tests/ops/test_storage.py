"""Memory that an update frees is kept for the next one."""

import ctypes
import subprocess
import sys

import pytest

HELD = """
import ctypes, torch
from torchelev.ops.storage import keep_freed_memory

class MallInfo(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")]

mallinfo2 = ctypes.CDLL(None).mallinfo2
mallinfo2.restype = MallInfo

def kept_of_a_freed_block(size):
    before = mallinfo2()
    torch.empty(size, dtype=torch.uint8)
    after = mallinfo2()
    return after.arena + after.hblkhd - before.arena - before.hblkhd  # what malloc has from the system, used or not

print(kept_of_a_freed_block(2**23))
keep_freed_memory()
print(kept_of_a_freed_block(2**24))  # larger: freeing a block alone lets malloc keep its like
"""


@pytest.mark.slow(1)
@pytest.mark.skipif(
    not sys.platform.startswith("linux") or not hasattr(ctypes.CDLL(None), "mallinfo2"),
    reason="other allocators keep memory by rules of their own",
)
def test_freed_memory_is_kept():
    run = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, check=True)
    by_default, kept = (int(line) for line in run.stdout.split())
    assert by_default < 2**20 < 2**23 < kept, (by_default, kept)
