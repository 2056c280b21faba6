"""The workload gives every stage something to do."""

import pytest

from benchmarks.speed.common.workload import Drive, full_config


@pytest.mark.slow(1)
@pytest.mark.parametrize("robots", [1, 3])
def test_every_stage_has_work(robots):
    drive = Drive(full_config(64), 512, robots=robots, compiled=False, scans=4)
    drive.warm_up()
    assert min(drive.seen.values()) > 0


@pytest.mark.slow(1)
def test_idle_stages_are_refused():
    drive = Drive(full_config(64), 512, compiled=False, scans=1)
    drive.clouds[0][..., 2] = -0.8
    with pytest.raises(AssertionError, match="stages without effect"):
        drive.warm_up()
