"""The benchmarks of sites measure what they say, write it and tabulate it."""

import json

import pytest
import torch
from click.testing import CliRunner

pytest.importorskip("tensorstore", reason="needs torchelev[site]")

from benchmarks.speed.site import site_area, site_merge
from benchmarks.speed.site.site_windows import RESOLUTION, Windows, ground, lattice
from torchelev.site import SiteMap


def test_windows_know_all_of_the_ground_and_count_as_measured_anew():
    windows, site = Windows(4, 32), SiteMap(RESOLUTION)
    for number in range(2):
        windows.look(lattice(4, 16) + 4 * number)
        report = site.merge(windows.emap)
        assert report.new_cells.tolist() == [32 * 32] * 4 and not report.contradictions.any()
    error = report.offsets - windows.offsets
    assert float(error.max() - error.min()) < 2e-3
    xy = torch.tensor([[0.6, 0.7], [4.0, 4.2]])
    values, valid = site.sample(xy)
    assert valid.all()
    torch.testing.assert_close(values + error.mean(), ground(*xy.T), atol=5e-3, rtol=0.0)


def test_hops_cover_the_whole_area():
    known, sizes = torch.zeros(1000, 1000, dtype=torch.bool), site_area.Sizes()
    for x, y in site_area.hops(100, sizes).flatten(0, 1).tolist():
        known[x : x + sizes.cells, y : y + sizes.cells] = True
    assert known.all() and len(site_area.hops(100, sizes)) == 4


@pytest.mark.slow(2)
def test_two_merges_are_measured_and_tabulated(tmp_path):
    small, options = site_merge.Sizes((1, 4), 16, 8), ["--rounds", "2", "--out", str(tmp_path)]
    result = CliRunner().invoke(site_merge.main, options, obj=small, catch_exceptions=False)
    assert result.exit_code == 0
    rows = json.loads((tmp_path / "site_merge.json").read_text())["rows"]
    assert [row["robots"] for row in rows] == [1, 4] and "| 4 |" in result.output
    for row in rows:
        assert all(row[place][kind] > 0 for place in ("memory", "disk") for kind in ("first", "steady"))
        assert row["peak_bytes"] > 0 and row["disk_bytes"] > 0 and row["tiles"] > 0


@pytest.mark.slow(4)
def test_two_areas_are_measured_and_tabulated(tmp_path):
    small = site_area.Sizes(4, 32, 24, 100, 2.0, 0.01, apart=lambda function, *arguments: function(*arguments))
    options = ["--sides", "8", "--sides", "10", "--out", str(tmp_path)]
    result = CliRunner().invoke(site_area.main, options, obj=small, catch_exceptions=False)
    assert result.exit_code == 0
    rows = json.loads((tmp_path / "site_area.json").read_text())["rows"]
    assert [len(row["merge_ms"]) for row in rows] == [3, 4] and "| 8 × 8 m |" in result.output
    for row in rows:
        assert row["known"] > 0.95 and row["disk_bytes"] > 0 and row["explorer_mb"] > row["torch_mb"] > 50
        assert all(row[name] > 0 for name in ("open_ms", "sample_ms", "sample_near_ms", "window_ms"))
