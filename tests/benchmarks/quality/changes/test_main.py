"""The command: what it writes and tabulates."""

import json

from click.testing import CliRunner

from benchmarks.quality.changes import ghosts, obstacles
from benchmarks.quality.changes.__main__ import main
from benchmarks.quality.changes.world import SENSORS

GONE = {"cells": 3, "environments": 2, "seen_through": 0, "environments_seen_through": 0, "of": 50}


def test_the_command_writes_and_tabulates(monkeypatch, tmp_path):
    monkeypatch.setattr(obstacles, "WATCHED", 3)
    monkeypatch.setattr(obstacles, "obstacle_scans", lambda *given: {"median": 3, "most": 4, "points": 0.5})
    monkeypatch.setattr(obstacles, "plate_scans", lambda *given: {"rmse_mm": 0.2, "median": 3, "most": 61})
    monkeypatch.setattr(ghosts, "ghosts", lambda *given: GONE)
    result = CliRunner().invoke(main, ["--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "| box, 100.0% of the points | 0.5 | 3 | > 3 |" in result.output
    assert len(json.loads((tmp_path / "changes.json").read_text())["ghosts"]) == len(SENSORS) * len(ghosts.HERTZ)
