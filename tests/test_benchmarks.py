"""The speed benchmarks: what they count, fit and compare."""

import json
import subprocess
import sys

import pytest
import torch

from benchmarks import meter, speed_plots, speed_tables
from benchmarks.readme import ROOT, SPEED, load
from benchmarks.run import regressions, timings
from benchmarks.workload import Drive, full_config
from torchelev import ElevationMap


@pytest.mark.parametrize("robots", [1, 3])
def test_every_stage_has_work(robots):
    drive = Drive(full_config(64), 512, robots=robots, compiled=False, scans=4)
    drive.warm_up()
    assert min(drive.seen.values()) > 0


def test_idle_stages_are_refused():
    drive = Drive(full_config(64), 512, compiled=False, scans=1)
    drive.clouds[0][..., 2] = -0.8
    with pytest.raises(AssertionError, match="stages without effect"):
        drive.warm_up()


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
    held = sum(buffer.nbytes for buffer in emap.buffers())
    assert meter.state_bytes(cfg) == held
    assert meter.needed_memory(cfg, 100) == held + 1200 + meter.table_bytes(cfg)
    assert meter.needed_traffic(cfg, 100) == 2 * held + 1200 + 2 * meter.table_bytes(cfg)


def test_exponent():
    assert meter.exponent([1, 10, 100], [3, 30, 300]) == pytest.approx(1)
    assert meter.exponent([2, 4, 8], [5, 5 * 4, 5 * 16]) == pytest.approx(2)


def test_regressions_need_median_and_minimum():
    old = {"points": {"full": [{"points": n, "median": 2.0, "min": 1.0} for n in (10, 20, 30)]}, "new": {}}
    new = {
        "points": {"full": [{"points": n, "median": m, "min": k} for n, m, k in ((10, 4, 1), (20, 4, 2), (30, 2, 1))]}
    }
    assert regressions(old, old) == []
    (found,) = regressions(new, old)
    assert found.startswith("/points/full/points 20: 2.000 -> 4.000 ms")


def test_committed_result_has_its_table_and_picture(tmp_path):
    result = load(SPEED)
    assert len(list(timings(result))) > 40
    assert "| case | measured | target |" in speed_tables.report(result)
    speed_plots.draw(result, tmp_path / "speed.png")
    assert (tmp_path / "speed.png").stat().st_size > 10_000


def run_compare(new, old):
    command = [sys.executable, "-m", "benchmarks.run", "--compare", str(new), "--against", str(old)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


def test_compare_fails_on_a_regression(tmp_path):
    fast, slow = tmp_path / "fast.json", tmp_path / "slow.json"
    fast.write_text(json.dumps({"update": {"median": 1.0, "min": 0.9}}))
    slow.write_text(json.dumps({"update": {"median": 3.0, "min": 2.9}}))
    worse, better = run_compare(slow, fast), run_compare(fast, slow)
    assert (worse.returncode, better.returncode) == (1, 0), worse.stderr
    assert "/update: 1.000 -> 3.000 ms" in worse.stdout
