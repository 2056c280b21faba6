"""The benchmark of the live view measures and tabulates."""

import json

import pytest
from click.testing import CliRunner

pytest.importorskip("viser", reason="needs torchelev[view]")

from benchmarks.speed import live_view
from torchelev import GridConfig


@pytest.mark.slow(12)
def test_two_pictures_are_measured_and_tabulated(tmp_path, monkeypatch):
    small = {
        "GRID": GridConfig(resolution=0.04, length_x=4.0, length_y=4.0),
        "CLIENTS": (1,),
        "THREADS": (1,),
        "PERIODS": (0.0, 0.05),
    }
    quick = {"NUM_POINTS": 100, "PAIRS": 1, "SECONDS": 0.2, "PICTURES": 2}
    for name, value in (small | quick).items():
        monkeypatch.setattr(live_view, name, value)
    result = CliRunner().invoke(live_view.main, ["--out", str(tmp_path)], catch_exceptions=False)
    assert result.exit_code == 0
    written = json.loads((tmp_path / "live_view.json").read_text())
    assert written["rates"][0]["pictures_per_s"] > 0 and all(loop["ratio"] > 0 for loop in written["loops"])
    assert "| pictures a second, 1 client |" in result.output
