"""A process that was forked after maps were used computes on one thread, says so, and does not wait forever."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import os, signal, sys, warnings
import torch
from torchelev import ElevationMap, ElevationMapConfig, GridConfig

torch.set_num_threads(2)
cfg = ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=4.0, length_y=4.0))
points, T = torch.rand(1, 4000, 3), torch.eye(4)[None]
emap = ElevationMap(cfg)
emap.update(points, T, T, dt=0.1)
torch.rand(1_000_000).sin().sum()  # starts the threads

child = os.fork()
if child == 0:
    signal.alarm(20)  # ends the child if it waits forever
    for _ in range(2):
        emap.update(points, T, T, dt=0.1)
    print("child", torch.get_num_threads(), int(emap.statistics.points_used), flush=True)
    os._exit(0)
print("parent", os.waitpid(child, 0)[1], torch.get_num_threads())
"""


@pytest.mark.slow(6)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="cannot fork")
def test_a_forked_child_goes_on_with_one_thread_and_says_so():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=60)
    first, second = done.stdout.splitlines()
    assert first.startswith("child 1 ") and int(first.split()[2]) > 0 and second == "parent 0 2", done
    assert done.stderr.count('AsyncVectorEnv(..., context="spawn")') == 1, done.stderr
