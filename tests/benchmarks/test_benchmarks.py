"""The speed benchmarks: what they count, fit and compare."""

import copy
import json
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from benchmarks import gpu
from benchmarks.speed import long_run, meter, postprocessing, run
from benchmarks.speed import plots as speed_plots
from benchmarks.speed import sections as speed_sections
from benchmarks.speed import tables as speed_tables
from benchmarks.speed.run import regressions, timings
from benchmarks.speed.workload import Drive, full_config
from docs.readme_tables import ROOT, SPEED, load
from torchelev import ElevationMap
from training.traversability import block


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
    assert regressions(old, old) == ([], 3)
    (found,), count = regressions(new, old)
    assert found == "/points/full/points 20: median 2.000 -> 4.000 ms (2.00 x), min 1.000 -> 2.000 ms (2.00 x)"
    assert count == 3


def test_committed_result_has_its_table_and_picture(tmp_path):
    result = load(SPEED)
    assert len(list(timings(result))) > 40
    assert "| case | measured | target |" in speed_tables.report(result)
    speed_plots.draw(result, tmp_path / "speed.png")
    assert (tmp_path / "speed.png").stat().st_size > 10_000


def test_time_neither_grows_nor_falls_with_ray_length():
    verdicts = [speed_tables.verdicts({"rays": {"exponent": p}}).splitlines()[-1] for p in (-0.2, 0.05, 0.2)]
    assert [row.split("|")[-2].strip() for row in verdicts] == ["missed", "met", "missed"]


def test_eager_updates_may_take_four_times_what_compiled_ones_may():
    rows = [{"points": n, "median": limit} for n, limit in speed_tables.TARGETS.items()]
    slow = [row | {"median": factor * row["median"]} for row, factor in zip(rows, (3.9, 4.1, 4.0), strict=True)]
    result = {"points": {"full": rows, "eager": slow, "exponent_from_43074": 0.5, "graphs": 3}}
    verdicts = [row for row in speed_tables.verdicts(result).splitlines() if "eager" in row]
    assert [row.split("|")[-2].strip() for row in verdicts] == ["met", "missed", "met"]
    assert "9.8 ms, 3.9 x compiled" in verdicts[0]


@pytest.fixture
def eager(monkeypatch):
    """Skip compiling, which takes half a minute."""
    monkeypatch.setattr(ElevationMap, "compile", lambda self: None)


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


def test_long_run_sees_growth():
    steady = {"updates": 400, "ms": [9.0, 3.0, 3.1, 3.0] * 3, "resident_bytes": [10**8] * 12, "graphs": [1] * 12}
    steady |= {"reference_ms": [9.1, 3.0, 3.0, 3.1] * 3, "old_ms": [3.0, 6.0, 3.1], "new_ms": [3.0, 6.1, 3.0]}
    worse_machine = steady | {name: [3.0 + 0.1 * k for k in range(12)] for name in ("ms", "reference_ms")}
    slower = steady | {"ms": [ms * (1 + 0.008 * k) for k, ms in enumerate(steady["ms"])]}
    older = steady | {"new_ms": [2.8, 5.6, 2.7]}
    larger = steady | {"resident_bytes": [10**8 + 10**6 * k for k in range(12)]}
    again = steady | {"graphs": [1] * 6 + [2] * 6}
    cases = [steady, worse_machine, slower, older, larger, again]
    rows = long_run.verdicts({str(number): values for number, values in enumerate(cases)})
    assert [row[-1] for row in rows] == ["none grows"] * 2 + ["GROWS"] * 4


class Slowing:
    """In place of a timer: the more updates it timed, the longer one takes."""

    def __init__(self, growth):
        self.growth, self.done = growth, 0

    def timeit(self, updates):
        self.done += updates
        return SimpleNamespace(mean=1e-3 * (1 + self.growth * self.done))


@pytest.mark.parametrize("growth, verdict", [(0.0, "none grows"), (1e-4, "GROWS")])
def test_long_run_sees_what_its_updates_slow(monkeypatch, growth, verdict):
    """By a fifth in 2,000 updates; each process has its own count, and the reference's hardly grows."""
    own, saved = threading.local(), []
    drive = SimpleNamespace(emap=SimpleNamespace(validity=torch.ones(1)))
    monkeypatch.setattr(long_run, "ProcessPoolExecutor", lambda workers, kind: ThreadPoolExecutor(workers))
    monkeypatch.setattr(long_run, "start", lambda case: (drive, Slowing(growth)))
    monkeypatch.setattr(long_run, "started", lambda case, threads: vars(own).setdefault("timer", Slowing(growth)))
    monkeypatch.setattr(long_run, "resident_bytes", lambda: 10**8)
    long_run.run_case("one robot", 2000, lambda values: saved.append(copy.deepcopy(values)))
    ((_, _, _, over_reference, over_new, *_, said),) = long_run.verdicts({"one robot": saved[-1]})
    assert len(saved) == long_run.BLOCKS + 1 and said == verdict
    assert (float(over_reference) > long_run.GROWTH) == (float(over_new) > long_run.GROWTH) == (growth > 0)


def test_drives_of_a_long_run_vary_in_length_and_place():
    drive = Drive(full_config(64), 400, compiled=False, scans=4)
    long_run.onward(drive)
    scans = [drive.next_scan() for _ in range(50)]
    assert {cloud.shape[1] for cloud, _ in scans} == {400, 390, 380, 370}
    torch.testing.assert_close(scans[49][1][0, 0, 3].item(), 0.04 * 50)


@pytest.mark.slow(6)
@pytest.mark.parametrize("section", ["rays", "points", "robots", "cells"])
def test_sections_measure_at_small_sizes(section, monkeypatch, eager):
    small = {"RAYS": [1.2, 4.8], "POINTS": [6276, 43074, 50000], "ROBOTS": [1, 2, 3], "CELLS": [50, 60, 70]}
    for name, values in small.items():
        monkeypatch.setattr(speed_sections, name, values)
    monkeypatch.setattr(speed_sections, "SENSORS", [("none", 6276, 1, 1)])
    result = {section: speed_sections.SECTIONS[section](0.001, lambda values: values)}
    assert len(list(timings(result))) >= 2


@pytest.mark.slow(3)
def test_one_section_into_a_new_folder(tmp_path, monkeypatch, capsys, eager):
    monkeypatch.setattr(speed_sections, "RAYS", [1.2, 4.8])
    monkeypatch.setattr(sys, "argv", ["run", "rays", "--out", str(tmp_path), "--seconds", "0.001"])
    assert run.main() == 0
    assert "growth with ray length" in capsys.readouterr().out
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".png"}


def test_gpu_comparison():
    first = gpu.driven("cpu", compiled=False, robots=1, updates=2)
    assert set(gpu.compare(first, first).values()) == {0.0}
    other = copy.deepcopy(first)
    other.elevation += 0.5
    other.validity[:, 0] = ~other.validity[:, 0]
    result = gpu.compare(first, other)
    assert result["median_difference_m"] == pytest.approx(0.5)
    assert result["cells_known_by_one_alone"] == pytest.approx(1 / 64)


def test_gpu_verdicts_of_what_was_measured():
    result = {
        "correctness": {"run to run, deterministic": {"largest_difference_m": 0.0}},
        "host never waits, eager": {"holds": True},
        "host never waits, compiled": {"error": "called a synchronizing CUDA operation"},
        "one robot, captured": {"median": 0.2},
        "many robots, update": {"median": 8.0},
        "many robots, captured": {"median": 4.0},
        "many robots, expected bytes": 10**9,
        "copy, bytes per second": 10**12,
    }
    assert [row[-1] for row in gpu.verdicts(result)] == ["met", "missed", "met", "met", "met"]
    assert [row[-1] for row in gpu.verdicts({"correctness": {"error": "none"}})] == ["missed", "met"]


def run_compare(new, old):
    command = [sys.executable, "-m", "benchmarks.speed.run", "--compare", str(new), "--against", str(old)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


@pytest.mark.slow(10)
def test_compare_fails_on_a_regression(tmp_path):
    fast, slow = tmp_path / "fast.json", tmp_path / "slow.json"
    fast.write_text(json.dumps({"update": {"median": 1.0, "min": 0.9}}))
    slow.write_text(json.dumps({"update": {"median": 3.0, "min": 2.9}}))
    other = tmp_path / "other.json"
    other.write_text("{}")
    worse, better, none = run_compare(slow, fast), run_compare(fast, slow), run_compare(fast, other)
    assert (worse.returncode, better.returncode, none.returncode) == (1, 0, 2), worse.stderr
    assert "/update: median 1.000 -> 3.000 ms (3.00 x)" in worse.stdout
    assert "no such file" in run_compare(fast, tmp_path / "missing.json").stderr


@pytest.mark.parametrize("name", [name for name, (_, _, same) in postprocessing.cases().items() if same])
def test_filters_give_what_opencv_and_scipy_give(name):
    ours, peer, _ = postprocessing.cases()[name]
    layer = postprocessing.ground(2, 40)
    values, known = ours(layer)
    expected = np.stack([peer(*arrays) for arrays in zip(layer[0].numpy(), layer[1].numpy(), strict=True)])
    assert bool(known.any())
    np.testing.assert_allclose(
        values[known], expected[known.numpy()], atol=2e-3 if name == "standard_deviation" else 1e-4
    )


def test_postprocessing_is_measured_and_tabulated(monkeypatch):
    monkeypatch.setattr(postprocessing, "SIZES", ((1, 20), (2, 16)))
    rows = postprocessing.measure(0.0)
    text = postprocessing.table(rows)
    assert all(f"| {name} |" in text for name in postprocessing.cases())


def test_beside_a_block_heads_are_compared_with_the_truth(monkeypatch, tmp_path):
    monkeypatch.setattr(block, "RESULTS", tmp_path)
    monkeypatch.setattr(block, "HEIGHTS", (0.05, 0.4))
    assert CliRunner().invoke(block.main, []).exit_code == 0
    low, high = json.loads((tmp_path / "block.json").read_text())["profiles"]
    assert (tmp_path / "block.png").stat().st_size > 5000
    before, label = np.array(high["x"]), np.array(high["label"])
    assert min(low["label"]) == 1 and (label[before < -0.6] == 1).all()
    assert (label[np.abs(before) < 0.1] == 0).all() and len(label) == len(high["learned"]) == len(high["analytic"])
    wrong = {"height": 0.4, "label": [0.0, 0.0, 1.0, 1.0], "learned": [0.5, 0.1, 1.0, 0.8]}
    assert block.row(wrong, "learned") == ["40 cm", "learned", "0.20", "0.30", "1 of 2"]
