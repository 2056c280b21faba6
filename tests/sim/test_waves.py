"""Sums of sines: their heights, and the bound of their slope."""

import math

import pytest
import torch

from torchelev.sim.waves import Waves, even_waves, natural_waves


def test_a_single_wave_is_a_sine_along_its_heading():
    wave = Waves([0.1], [2.0], [math.pi / 2], [0.3])
    x, y = torch.rand(2, 50, dtype=torch.float64)
    torch.testing.assert_close(wave(x, y), 0.1 * torch.sin(math.pi * y + 0.3))
    assert wave.steepness == pytest.approx(0.1 * math.pi)


@pytest.mark.parametrize("draw", [natural_waves, lambda seed: even_waves(torch.Generator().manual_seed(seed), 0.03)])
def test_no_slope_exceeds_the_bound_and_seeds_decide(draw):
    waves, h = draw(1), 1e-6
    x, y = 8 * torch.rand(2, 5000, dtype=torch.float64) - 4
    gx = (waves(x + h, y) - waves(x - h, y)) / (2 * h)
    gy = (waves(x, y + h) - waves(x, y - h)) / (2 * h)
    assert float(torch.hypot(gx, gy).max()) <= waves.steepness + 1e-6
    assert torch.equal(waves(x, y), draw(1)(x, y)) and not torch.equal(waves(x, y), draw(2)(x, y))
