"""Tables and figure of a speed result, and the verdicts on its targets."""

import pytest

from benchmarks.speed.run import timings
from benchmarks.speed.update import plots, tables
from docs.results import SPEED, load


@pytest.mark.slow(2)
def test_committed_result_has_its_table_and_picture(tmp_path):
    result = load(SPEED)
    assert len(list(timings(result))) > 40
    assert "| case | measured | target |" in tables.report(result)
    plots.draw(result, tmp_path / "speed.png")
    assert (tmp_path / "speed.png").stat().st_size > 10_000


def test_time_neither_grows_nor_falls_with_ray_length():
    verdicts = [tables.verdicts({"rays": {"exponent": p}}).splitlines()[-1] for p in (-0.2, 0.05, 0.2)]
    assert [row.split("|")[-2].strip() for row in verdicts] == ["missed", "met", "missed"]


def test_updates_by_tensors_may_take_twelve_times_what_others_may():
    rows = [{"points": n, "median": limit} for n, limit in tables.TARGETS.items()]
    slow = [row | {"median": factor * row["median"]} for row, factor in zip(rows, (11.9, 12.1, 12.0), strict=True)]
    result = {"points": {"full": rows, "eager": slow, "exponent_from_43074": 0.5}}
    verdicts = [row for row in tables.verdicts(result).splitlines() if "by tensors" in row]
    assert [row.split("|")[-2].strip() for row in verdicts] == ["met", "missed", "met"]
    assert "23.8 ms, 11.9 x compiled code" in verdicts[0]
