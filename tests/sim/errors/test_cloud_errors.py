"""Clouds get the same errors in C++ as by tensors."""

import dataclasses

import pytest
import torch

from tests.sim.errors.error_cases import LIVELY, NAN, rays
from torchelev.kernels.cpu_build import find_compiler
from torchelev.sim.errors import cloud_kernel
from torchelev.sim.errors.cloud_errors import disturb, disturb_in_torch, draw
from torchelev.sim.errors.error_models import SensorErrorConfig, SensorErrors
from torchelev.sim.errors.presets import preset

CONFIGS = {
    "all": LIVELY,
    "depth_camera": preset("depth_camera").sensor,
    "spinning_lidar": preset("spinning_lidar").sensor,
    "none": SensorErrorConfig(),
    **{
        name: SensorErrorConfig(**fields)
        for name, fields in {
            "flying": {"flying": 0.5},
            "artefacts": {"too_short": 0.2, "too_long": (0.0, 0.3)},
            "range noise": {"range_constant": 0.01, "range_quadratic": (0.0, 0.01)},
            "range step": {"range_step": (0.0, 0.05)},
            "point noise": {"point_noise": 0.02},
            "outliers": {"point_noise": 0.02, "outliers": 0.3, "outlier_noise": 0.5},
            "disparity": {"disparity_step": (0.0, 0.02)},
            "losses": {"dropout": 0.3, "missed_frames": 0.3},
        }.items()
    },
}


def a_cloud(B=12, h=6, w=7):
    """Images of two distances, with points behind the sensor and without return."""
    points = rays(B, h * w, seed=3)
    points[:, ::5] *= 0.3
    points[torch.rand(B, h * w, generator=torch.Generator().manual_seed(1)) < 0.1] = NAN
    return points, (h, w)


@pytest.mark.skipif(find_compiler() is None, reason="no compiler")
@pytest.mark.parametrize("is_image", [True, False])
@pytest.mark.parametrize("name", CONFIGS)
def test_clouds_get_the_same_errors_in_cpp(name, is_image):
    points, shape = a_cloud()
    shape = shape if is_image else (1, points.shape[1])
    errors = SensorErrors(CONFIGS[name], len(points), seed=4)
    draws = draw(errors, points.shape[1])
    expected = disturb_in_torch(errors, points, draws, shape)
    before = points.clone()
    got = disturb(errors, points, draws, shape)
    torch.testing.assert_close(got, expected, rtol=2e-6, atol=2e-6, equal_nan=True)
    torch.testing.assert_close(points, before, rtol=0, atol=0, equal_nan=True)
    assert got.data_ptr() != points.data_ptr() and torch.equal(got.isnan(), expected.isnan())


def test_the_settings_in_cpp_are_those_of_the_config():
    names = [field.name for field in dataclasses.fields(SensorErrorConfig)]
    first = names.index(cloud_kernel.FIELDS[0])
    assert tuple(names[first : first + len(cloud_kernel.FIELDS)]) == cloud_kernel.FIELDS


def test_errors_are_differentiable():
    """Their gradient is that of tensors: C++ has none."""
    points, shape = a_cloud(2)
    errors = SensorErrors(LIVELY, 2)
    draws = draw(errors, points.shape[1])
    disturb(errors, points.requires_grad_(), draws, shape).nan_to_num().sum().backward()
    assert points.grad is not None and bool((points.grad != 0).any())
