"""The benchmark of the live view measures and tabulates."""

import json

import pytest
from click.testing import CliRunner

pytest.importorskip("viser", reason="needs torchelev[view]")

from benchmarks.speed import live_view
from torchelev import GridConfig


@pytest.mark.slow(8)
def test_two_pictures_are_measured_and_tabulated(tmp_path):
    """Each client is a process of its own."""
    small = live_view.Sizes(
        grid=GridConfig(resolution=0.04, length_x=4.0, length_y=4.0),
        clients=(1,),
        threads=(1,),
        periods=(0.05,),
        num_points=100,
        pairs=1,
        seconds=0.2,
        pictures=2,
    )
    result = CliRunner().invoke(live_view.main, ["--out", str(tmp_path)], obj=small, catch_exceptions=False)
    assert result.exit_code == 0
    written = json.loads((tmp_path / "live_view.json").read_text())
    assert written["rates"][0]["pictures_per_s"] > 0 and all(loop["ratio"] > 0 for loop in written["loops"])
    assert "| pictures a second, 1 client |" in result.output
