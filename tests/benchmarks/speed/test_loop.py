"""The benchmark of a 50 Hz loop: its rate, its figures, and what it writes."""

import json
import time

import pytest
from click.testing import CliRunner

from benchmarks.speed import loop


def test_a_loop_keeps_its_rate_and_does_not_catch_up():
    starts, waits = [], iter([0.0, 0.05, 0.0, 0.0, 0.0])

    def step():
        starts.append(time.perf_counter())
        time.sleep(next(waits))

    times = loop.loop(step, 5, period=0.02)
    assert times[1] >= 0.05
    gaps = [b - a for a, b in zip(starts, starts[1:], strict=False)]
    due = starts[1] + times[1]  # of the call after the late one, which may itself start a little late
    assert gaps[1] >= 0.05 and starts[4] - due >= 0.039, "after a late update the rate is kept, not exceeded"


def test_figures_by_hand():
    figures = loop.figures([0.001 * k for k in range(1, 101)], period=0.0905)
    assert figures == pytest.approx({"p50": 50, "p99": 99, "max": 100, "late": 0.1, "updates": 100})


@pytest.mark.slow(1)
def test_the_loop_is_timed_idle_and_beside_a_process():
    rows = loop.measure(3, threads=1, compiled=False, points=500)
    assert set(rows) == {"idle", "busy"} and all(row["updates"] == 3 and row["p50"] > 0 for row in rows.values())


def test_every_way_to_wait_is_written(tmp_path):
    row = loop.figures([0.008, 0.03])
    asked = []
    options = ["--seconds", "0.1", "--out", str(tmp_path)]
    result = CliRunner().invoke(
        loop.main, options, obj=lambda *given: asked.append(given) or {"idle": row, "busy": row}
    )
    assert result.exit_code == 0, result.output
    assert asked == [("long", 5, 2), ("adapted", 5, 2), ("PASSIVE", 5, 2)]
    assert "| PASSIVE | busy | 8.0 | 30.0 | 30.0 | 50.0 |" in result.output
    assert json.loads((tmp_path / "loop.json").read_text())["rows"]["PASSIVE"]["idle"] == row
