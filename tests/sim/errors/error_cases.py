"""What the tests of errors share: clouds, poses, a config with all errors, and bounds on statistics."""

import math

import torch

from torchelev.sim.errors.error_models import SensorErrorConfig, SensorErrors

NAN = float("nan")
LIVELY = SensorErrorConfig(
    flying=(0.1, 0.9),
    too_short=(0.0, 0.1),
    too_long=0.05,
    range_constant=(0.0, 0.01),
    range_quadratic=0.002,
    range_step=0.001,
    point_noise=(0.0, 0.01),
    outliers=0.02,
    outlier_noise=0.2,
    disparity_step=0.001,
    dropout=(0.0, 0.3),
    missed_frames=0.2,
    latency=(0, 3),
    mounting_position=(0.0, 0.02),
    mounting_rotation_deg=1.0,
)


def rays(B, M, distance=None, seed=0):
    """Points (B, M, 3) in all directions, 1 to 4 m away or all at one distance."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(B, M, 3, generator=g), dim=-1)
    return direction * (1 + 3 * torch.rand(B, M, 1, generator=g) if distance is None else distance)


def poses(B, x=0.0):
    """Identity poses but for x."""
    T = torch.eye(4).repeat(B, 1, 1)
    T[:, 0, 3] = x
    return T


def make(num_envs=1, seed=0, **fields):
    """Errors of a config."""
    return SensorErrors(SensorErrorConfig(**fields), num_envs, seed=seed)


def assert_mean(sample, mean, sigma):
    """The sample's mean is that of a distribution with this mean and sigma."""
    assert abs(float(sample.double().mean()) - mean) <= 5 * sigma / math.sqrt(sample.numel())


def assert_sigma(sample, sigma):
    """The sample's standard deviation is that of a normal distribution with this sigma."""
    assert abs(float(sample.double().std()) - sigma) <= 5 * sigma / math.sqrt(2 * sample.numel())


def assert_share(sample, share):
    """The share of True is that of independent draws."""
    assert_mean(sample, share, math.sqrt(share * (1 - share)))
