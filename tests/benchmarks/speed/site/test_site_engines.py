"""The benchmark of storage engines stores the same tiles with each, and tabulates what it measures."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

pytest.importorskip("tensorstore", reason="needs torchelev[site]")

from benchmarks.speed.site import site_engines
from torchelev.site.tiles import LAYERS, TILE

TILES = [(-3, 2), (0, 0)]


def test_the_table_marks_what_takes_more_than_the_limit():
    rows = [
        {"engine": engine, "tiles": 1, "open_ms": ms, "read_ms": 2.0, "bytes_1": 3_000_000, "peak_mb": 40.0}
        for engine, ms in zip(site_engines.ENGINES, (1.0, 1.5, 1.4), strict=True)
    ]
    table = site_engines.table(rows)
    assert "| open [ms] | 1.0 | 1.5 | 1.4 | **1.40** |" in table and "| 2.0 | 2.0 | 2.0 | 1.00 |" in table
    assert "| on disk after 1 merge [MB] | 3.0 | 3.0 | 3.0 | 1.00 |" in table and "| – | – | – | – |" in table


@pytest.mark.parametrize("written, read", [(False, True), (True, False)])
def test_chunks_are_those_of_zarr(tmp_path, written, read):
    store = pytest.importorskip("benchmarks.speed.site.icechunk_store", exc_type=ImportError)
    values = np.random.default_rng(0).normal(size=(2, len(LAYERS), TILE, TILE)).astype(np.float32)
    values[0, 1] = np.nan
    with store.IcechunkStore(tmp_path / "site", raw=written) as writer:
        writer.commit(TILES, values, {"time": 1.5, "channels": {}, "variance_rate": None})
    reader = store.IcechunkStore(tmp_path / "site", raw=read, read_only=True)
    assert reader.tiles == set(TILES) and reader.attributes["time"] == 1.5
    np.testing.assert_array_equal(reader.read(TILES), values)


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
