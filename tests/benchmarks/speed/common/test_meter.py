"""Peak memory, minimum memory and traffic, and growth exponents."""

import pytest
import torch

from benchmarks.speed.common import meter
from benchmarks.speed.common.workload import full_config
from torchelev import ElevationMap


def test_peak_bytes_counts_what_is_held_at_once():
    def run():
        for _ in range(3):
            first = torch.empty(1000)
            second = torch.empty(500)
            del first, second

    assert 6000 <= meter.peak_bytes(run) < 7000


def test_needed_memory():
    cfg = full_config(64)
    emap = ElevationMap(cfg)
    held = sum(buffer.nbytes for buffer in emap.buffers()) - emap.num_resets.nbytes  # which is no part of the state
    assert meter.state_bytes(cfg) == held
    assert meter.needed_memory(cfg, 100) == held + 1200 + meter.table_bytes(cfg)
    assert meter.needed_traffic(cfg, 100) == 2 * held + 1200 + 2 * meter.table_bytes(cfg)


def test_exponent():
    assert meter.exponent([1, 10, 100], [3, 30, 300]) == pytest.approx(1)
    assert meter.exponent([2, 4, 8], [5, 5 * 4, 5 * 16]) == pytest.approx(2)
