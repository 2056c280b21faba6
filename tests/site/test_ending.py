"""A process that ends while threads of other libraries still hand over their results."""

import subprocess
import sys

import pytest

# What Gloo's and Icechunk's threads do, with a thread that Python would otherwise end in its sleep.
PROGRAM = """
import threading, time
import torch.distributed as dist
{}
def hand_over():
    time.sleep(0.02)
    print("handed over", flush=True)
threading.Thread(target=hand_over, daemon=True).start()
"""
RANKS = """
dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)
from torchelev.site.shared.ranks import Ranks
Ranks(dist.group.WORLD)
"""
REPOSITORY = """
from torchelev.site.storage.versioned.repository import import_icechunk
import_icechunk()
"""


@pytest.mark.parametrize("begin", [RANKS, REPOSITORY], ids=["ranks", "repository"])
def test_waits_for_threads(begin):
    result = subprocess.run([sys.executable, "-c", PROGRAM.format(begin)], capture_output=True, text=True, timeout=90)
    assert (result.returncode, result.stdout) == (0, "handed over\n"), result.stderr
