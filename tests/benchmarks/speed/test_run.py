"""The command of the speed benchmarks: one section alone, and regressions between two results."""

import json

import pytest

from benchmarks.speed import run
from benchmarks.speed.run import regressions
from benchmarks.speed.update import scaling


def test_regressions_need_median_and_minimum():
    old = {"points": {"full": [{"points": n, "median": 2.0, "min": 1.0} for n in (10, 20, 30)]}, "new": {}}
    new = {
        "points": {"full": [{"points": n, "median": m, "min": k} for n, m, k in ((10, 4, 1), (20, 4, 2), (30, 2, 1))]}
    }
    assert regressions(old, old) == ([], 3)
    (found,), count = regressions(new, old)
    assert found == "/points/full/points 20: median 2.000 -> 4.000 ms (2.00 x), min 1.000 -> 2.000 ms (2.00 x)"
    assert count == 3


@pytest.mark.slow(3)
def test_one_section_into_a_new_folder(tmp_path, capsys):
    small = scaling.Sizes(rays=(1.2, 4.8))
    options = ["rays", "--out", str(tmp_path), "--seconds", "0.001", "--threads", "1"]
    assert run.main(options, {"rays": lambda seconds: scaling.rays(seconds, small)}) == 0
    assert "growth with ray length" in capsys.readouterr().out
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".png"}


@pytest.mark.slow(12)
def test_compare_fails_on_a_regression(tmp_path, capsys):
    def compare(new, old):
        return run.main(["--compare", str(new), "--against", str(old)])

    fast, slow = tmp_path / "fast.json", tmp_path / "slow.json"
    fast.write_text(json.dumps({"update": {"median": 1.0, "min": 0.9}}))
    slow.write_text(json.dumps({"update": {"median": 3.0, "min": 2.9}}))
    other = tmp_path / "other.json"
    other.write_text("{}")
    assert compare(slow, fast) == 1 and "/update: median 1.000 -> 3.000 ms (3.00 x)" in capsys.readouterr().out
    assert compare(fast, slow) == 0 and compare(fast, other) == 2
    with pytest.raises(SystemExit):
        compare(fast, tmp_path / "missing.json")
    assert "no such file" in capsys.readouterr().err
