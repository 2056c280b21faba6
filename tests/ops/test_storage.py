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

def held():
    now = mallinfo2()
    return now.arena + now.hblkhd  # what malloc has from the system, used or not

def kept(size):
    before = held()
    torch.empty(size, dtype=torch.uint8)
    return held() - before

libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]

def kept_of_eight_blocks():
    before = held()
    blocks = [libc.malloc(2**24) for _ in range(8)]
    for block in reversed(blocks):
        libc.free(block)
    return held() - before

print(kept(2**23))
keep_freed_memory()
print(kept(2**24))  # larger: freeing a block alone lets malloc keep its like
print(kept_of_eight_blocks())
keep_freed_memory(2**28)
print(kept_of_eight_blocks())
"""


@pytest.mark.slow(1)
@pytest.mark.skipif(
    not sys.platform.startswith("linux") or not hasattr(ctypes.CDLL(None), "mallinfo2"),
    reason="other allocators keep memory by rules of their own",
)
def test_freed_memory_is_kept():
    run = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, check=True)
    by_default, kept, kept_of_many, kept_on_demand = (int(line) for line in run.stdout.split())
    assert by_default < 2**20 < 2**23 < kept, (by_default, kept)
    assert kept_of_many < 2**26 < kept_on_demand, (kept_of_many, kept_on_demand)
