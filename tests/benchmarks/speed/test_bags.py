"""The benchmark of bags: its drive is a right one, and what it measures is written and tabulated."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.speed import bags
from benchmarks.speed.common import bag_drive
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.io import MappingRun
from torchelev.io.bags import Bag, open_bag
from torchelev.sim import Lidar

LIDAR = Lidar(rings=8, azimuths=64)


@pytest.mark.slow(1)
def test_points_of_the_moving_lidar_lie_on_flat_ground(tmp_path):
    bag_drive.write_bag(tmp_path / "drive.mcap", 4, LIDAR)
    run = MappingRun(ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=6.0, length_y=6.0))))
    with Bag(tmp_path / "drive.mcap") as bag:
        recording = open_bag(bag, bags._REQUEST)
        for frame in recording:
            run.add(frame, frame.T_map_base)
    assert run.num_scans == 4 and not recording.warnings
    elevation = run.emap.layer("elevation")[0].numpy()
    x, y = np.moveaxis(run.emap.cell_centers()[0].numpy(), -1, 0)
    flat = elevation[np.isfinite(elevation) & (np.abs(x) < 1.0) & (np.abs(y) < 0.7)]
    assert len(flat) > 20 and np.abs(flat).max() < 0.02


@pytest.mark.slow(3)
def test_two_scans_are_measured_and_tabulated(tmp_path):
    small = bags.Sizes(LIDAR, 2, LIDAR, (2, 3), apart=lambda function, *arguments: function(*arguments))
    result = CliRunner().invoke(bags.main, ["--out", str(tmp_path)], obj=small, catch_exceptions=False)
    assert result.exit_code == 0
    rows = json.loads((tmp_path / "bags.json").read_text())["rows"]
    assert [row["format"] for row in rows] == [".bag", ".mcap", ".db3"]
    for row in rows:
        assert all(row["ms"][step] > 0 for step in ("read", "map")) and row["points"] == 8 * 64
        assert [memory["scans"] for memory in row["memory_mb"]] == [2, 3]
        assert all(100 < memory["start"] <= memory["peak"] for memory in row["memory_mb"])
        assert f"| {row['format']} |" in result.output
