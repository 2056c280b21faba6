"""Compiled updates with and without C++."""

import pytest
import torch

from tests.stages.visibility.test_native import drive
from torchelev.native.library import find_compiler
from torchelev.stages.visibility import native


@pytest.mark.compiles
@pytest.mark.slow(60)
@pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")
def test_compiled_updates_use_it_and_do_without_it(monkeypatch):
    calls = []
    run = native._library
    monkeypatch.setattr(native, "_library", lambda: calls.append(1) or run())
    fast = drive(True, 0, 2, 2.3, 4.1, 1, 1, compiled=True)
    assert native.Availability.found and len(calls) >= 8, "of each update: one to look for it, one to run it"
    calls.clear()
    slow = drive(False, 0, 2, 2.3, 4.1, 1, 1, compiled=True)
    assert not native.Availability.found and len(calls) == 4
    same = (fast.bounded == slow.bounded).float().mean()
    assert float(same) > 0.999, "the compiler rounds differently"
    both = fast.bounded & slow.bounded
    torch.testing.assert_close(fast.upper_bound[both], slow.upper_bound[both], rtol=0, atol=1e-4)
