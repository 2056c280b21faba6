"""The command: what it writes and tabulates."""

import json

import pytest
from click.testing import CliRunner

from benchmarks.quality.changes.__main__ import Measures, main
from benchmarks.quality.changes.ghosts import HERTZ
from benchmarks.quality.changes.obstacles import WATCHED
from benchmarks.quality.changes.world import SENSORS

GONE = {"cells": 3, "environments": 2, "seen_through": 0, "environments_seen_through": 0, "of": 50}


@pytest.mark.slow(1)
def test_the_command_writes_and_tabulates(tmp_path):
    measures = Measures(
        obstacles=lambda *_: {"median": 3, "most": WATCHED + 1, "points": 0.5},
        plates=lambda *_: {"rmse_mm": 0.2, "median": 3, "most": 61},
        ghosts=lambda *_: GONE,
    )
    result = CliRunner().invoke(main, ["--out", str(tmp_path)], obj=measures)
    assert result.exit_code == 0, result.output
    assert "| box, 100.0% of the points | 0.5 | 3 | > 40 |" in result.output
    assert len(json.loads((tmp_path / "changes.json").read_text())["ghosts"]) == len(SENSORS) * len(HERTZ)
