"""Sensors that disagree in height are named, in one call or in turns; noise and drift of the poses are not."""

import pytest
import torch

from tests.stages.test_disagreement import GRID, T, clouds, in_one_call, in_turns
from torchelev import ElevationMap, ElevationMapConfig


@pytest.mark.slow(1)
@pytest.mark.parametrize("bias", [0.02, 0.05, 0.1, -0.05])
def test_a_bias_of_one_call_is_named_with_its_sensor(bias):
    sentences = in_one_call(clouds(bias)).diagnose()
    where = "above" if bias > 0 else "below"
    assert f"sensor 1 sees the ground {100 * abs(bias):.1f} cm {where} sensor 0" in sentences[0]


@pytest.mark.slow(1)
@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("bias", [0.02, 0.05, 0.09])
def test_corrections_that_repeat_are_named(bias, count):
    (sentence,) = in_turns(clouds(bias, count, num_scans=12)).diagnose()
    moved = float(sentence.split("moves the map by ")[1].split(" cm")[0])
    assert moved == pytest.approx(100 * bias, abs=1.0) and f"every {count} updates" in sentence


@pytest.mark.slow(1)
def test_sensors_that_agree_are_passed_over():
    assert in_one_call(clouds(0.003)).diagnose() == [] and in_turns(clouds(0.003)).diagnose() == []


@pytest.mark.slow(1)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise, drift", [(0.015, 0.0), (0.015, 0.01), (0.01, 0.03)])
def test_noise_and_drift_of_poses_are_passed_over(seed, noise, drift):
    emap = ElevationMap(ElevationMapConfig(grid=GRID))
    noises = noise * torch.randn(40, generator=torch.Generator().manual_seed(seed))
    for k, points in enumerate(clouds(0.0, count=1, num_scans=40)):
        emap.update(points[:, 0] + torch.tensor([0.0, 0.0, drift * k + float(noises[k])]), T, T, dt=0.1)
        if k in (12, 17, 24, 39):
            assert emap.diagnose() == []
