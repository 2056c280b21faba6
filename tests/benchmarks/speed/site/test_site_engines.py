"""The benchmark of storage engines stores the same tiles with each, and tabulates what it measures."""

import json

import pytest
from click.testing import CliRunner

pytest.importorskip("tensorstore", reason="needs torchelev[site]")

from benchmarks.speed.site import site_engines


def test_the_table_marks_what_takes_more_than_the_limit():
    rows = [
        {"engine": engine, "tiles": 1, "open_ms": ms, "read_ms": 2.0, "bytes_1": 3_000_000, "peak_mb": 40.0}
        for engine, ms in zip(site_engines.ENGINES, (1.0, 1.4), strict=True)
    ]
    table = site_engines.table(rows)
    assert "| open [ms] | 1.0 | 1.4 | **1.40** |" in table and "| 2.0 | 2.0 | 1.00 |" in table
    assert "| on disk after 1 merge [MB] | 3.0 | 3.0 | 1.00 |" in table and "| – | – | – |" in table


@pytest.mark.slow(10)
def test_engines_are_measured_and_tabulated(tmp_path):
    pytest.importorskip("icechunk")
    small = site_engines.Sizes(4, 16, 8, 2, 1, apart=lambda function, *arguments: function(*arguments))
    options = ["--merges", "2", "--out", str(tmp_path)]
    result = CliRunner().invoke(site_engines.main, options, obj=small, catch_exceptions=False)
    assert result.exit_code == 0 and "| steady merge [ms] |" in result.output
    rows = json.loads((tmp_path / "site_engines.json").read_text())["rows"]
    assert [row["engine"] for row in rows] == list(site_engines.ENGINES)
    for row in rows:
        assert all(row[name] > 0 for name in ("first_ms", "steady_ms", "commit_ms", "open_ms", "read_ms", "bytes_1"))
