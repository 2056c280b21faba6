"""Long runs: each block is written, and growth is found."""

import contextlib
import copy
import json
from types import SimpleNamespace

import pytest
import torch

from benchmarks.speed import long_run
from benchmarks.speed.common import growth
from benchmarks.speed.common.workload import Drive, full_config


@pytest.mark.slow(3)
def test_long_run_writes_every_block(tmp_path, capsys):
    @contextlib.contextmanager
    def beside(case):
        timer = long_run.start(case)[1]
        yield lambda updates: long_run.milliseconds(timer, updates)

    cases = {"two robots": (2, 64, 400, 4)}
    long_run.main(["--out", str(tmp_path), "--threads", "1"], cases, new_process=beside)
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

    def milliseconds(self, updates):
        return long_run.milliseconds(self, updates)


@pytest.mark.parametrize("slowdown, verdict", [(0.0, "none grows"), (1e-4, "GROWS")])
def test_long_run_sees_what_its_updates_slow(slowdown, verdict):
    """By a fifth over 2,000 updates; each process counts its own, and those of the reference are few."""
    saved = []
    drive = SimpleNamespace(emap=SimpleNamespace(state=SimpleNamespace(validity=torch.ones(1))))
    how = {
        "start": lambda case: (drive, Slowing(slowdown)),
        "new_process": lambda case: contextlib.nullcontext(Slowing(slowdown).milliseconds),
    }
    case = long_run.CASES["one robot"]
    long_run.run_case("one robot", case, 2000, lambda values: saved.append(copy.deepcopy(values)), **how)
    ((_, _, _, over_reference, over_new, *_, said),) = growth.verdicts({"one robot": saved[-1]})
    assert len(saved) == long_run.BLOCKS + 1 and said == verdict
    assert (float(over_reference) > growth.GROWTH) == (float(over_new) > growth.GROWTH) == (slowdown > 0)


def test_drives_of_a_long_run_vary_in_length_and_place():
    drive = Drive(full_config(64), 400, compiled=False, scans=4)
    long_run.onward(drive)
    scans = [drive.next_scan() for _ in range(50)]
    assert {cloud.shape[1] for cloud, _ in scans} == {400, 390, 380, 370}
    torch.testing.assert_close(scans[49][1][0, 0, 3].item(), 0.04 * 50)
