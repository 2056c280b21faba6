"""Presets run, and have the numbers of their sources."""

import pytest
import torch

from tests.sim.errors.error_cases import poses, rays
from torchelev.sim.errors.error_models import SensorErrorConfig, SensorErrors
from torchelev.sim.errors.presets import PRESETS, preset


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run(name):
    errors = SensorErrors(preset(name).sensor, 3)
    got = errors(rays(3, 60), poses(3), image_shape=(6, 10))
    assert got.points.shape == (3, 60, 3) and got.points.dtype == torch.float32


def test_presets_have_the_numbers_of_their_sources():
    camera = SensorErrors(preset("depth_camera").sensor, 2000)
    at_one, at_four = camera.value("range_quadratic"), 16 * camera.value("range_quadratic")
    assert 0.0015 < float(at_one.min()) < 0.0016 and 0.0037 < float(at_one.max()) < 0.0038
    assert 0.024 < float(at_four.min()) and float(at_four.max()) < 0.061
    shares = [share for share, _ in preset("miki_2022").sensor]
    assert shares == [0.6, 0.3, 0.1]
    assert preset("ame_2").sensor.dropout == 0.15
    assert preset("perfect").sensor == SensorErrorConfig()
    with pytest.raises(ValueError, match="perfect, miki_2022, ame_2, depth_camera, spinning_lidar, leg_odometry"):
        preset("kinect")
