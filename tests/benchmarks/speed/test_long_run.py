"""Long runs: each block is written, and growth is found."""

import copy
import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch

from benchmarks.speed import growth, long_run
from benchmarks.speed.workload import Drive, full_config


@pytest.mark.slow(3)
def test_long_run_writes_every_block(tmp_path, monkeypatch, capsys, eager):
    monkeypatch.setattr(long_run, "CASES", {"two robots": (2, 64, 400, 4)})
    monkeypatch.setattr(long_run, "ProcessPoolExecutor", lambda workers, kind: ThreadPoolExecutor(workers))
    monkeypatch.setattr(sys, "argv", ["long_run", "--out", str(tmp_path), "--threads", "1"])
    long_run.main()
    values = json.loads((tmp_path / "long_run.json").read_text())["two robots"]
    assert {len(values[name]) for name in ("ms", "reference_ms", "resident_bytes", "graphs")} == {4}
    assert values["updates"] == 4 and values["known_share"] > 0.05
    assert len(values["old_ms"]) == len(values["new_ms"]) == long_run.ROUNDS and min(values["new_ms"]) > 0
    assert (tmp_path / "long_run.png").exists() and "| two robots |" in capsys.readouterr().out


class Slowing:
    """A timer by which an update takes longer, the more updates it has timed."""

    def __init__(self, slowdown):
        self.slowdown, self.done = slowdown, 0

    def timeit(self, updates):
        self.done += updates
        return SimpleNamespace(mean=1e-3 * (1 + self.slowdown * self.done))


@pytest.mark.parametrize("slowdown, verdict", [(0.0, "none grows"), (1e-4, "GROWS")])
def test_long_run_sees_what_its_updates_slow(monkeypatch, slowdown, verdict):
    """By a fifth over 2,000 updates; each process counts its own, and those of the reference are few."""
    own, saved = threading.local(), []
    drive = SimpleNamespace(emap=SimpleNamespace(state=SimpleNamespace(validity=torch.ones(1))))
    monkeypatch.setattr(long_run, "ProcessPoolExecutor", lambda workers, kind: ThreadPoolExecutor(workers))
    monkeypatch.setattr(long_run, "start", lambda case: (drive, Slowing(slowdown)))
    monkeypatch.setattr(long_run, "started", lambda case, threads: vars(own).setdefault("timer", Slowing(slowdown)))
    monkeypatch.setattr(long_run, "resident_bytes", lambda: 10**8)
    long_run.run_case("one robot", 2000, lambda values: saved.append(copy.deepcopy(values)))
    ((_, _, _, over_reference, over_new, *_, said),) = growth.verdicts({"one robot": saved[-1]})
    assert len(saved) == long_run.BLOCKS + 1 and said == verdict
    assert (float(over_reference) > growth.GROWTH) == (float(over_new) > growth.GROWTH) == (slowdown > 0)


def test_drives_of_a_long_run_vary_in_length_and_place():
    drive = Drive(full_config(64), 400, compiled=False, scans=4)
    long_run.onward(drive)
    scans = [drive.next_scan() for _ in range(50)]
    assert {cloud.shape[1] for cloud, _ in scans} == {400, 390, 380, 370}
    torch.testing.assert_close(scans[49][1][0, 0, 3].item(), 0.04 * 50)
