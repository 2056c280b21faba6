"""Smooth rough ground: sums of sines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Waves:
    """A sum of sines, z(x, y) = sum_k a_k sin(2 pi / l_k (x cos h_k + y sin h_k) + p_k)."""

    amplitude: Sequence[float]  #: [m] a
    length: Sequence[float]  #: [m] l, wavelength
    heading: Sequence[float]  #: [rad] h, direction in which the wave runs
    phase: Sequence[float]  #: [rad] p

    def __call__(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the height [m] at x, y [m], of any shape."""
        z = torch.zeros_like(x)
        waves = zip(self.amplitude, self.length, self.heading, self.phase, strict=True)
        for amplitude, length, heading, phase in waves:
            along = x * math.cos(heading) + y * math.sin(heading)
            z = z + amplitude * torch.sin(2 * math.pi / length * along + phase)
        return z

    @property
    def steepness(self) -> float:
        """An upper bound of the slope |gradient|."""
        return sum(2 * math.pi * a / length for a, length in zip(self.amplitude, self.length, strict=True))


def natural_waves(seed: int, amplitude: float = 0.08, count: int = 6) -> Waves:
    """Draw waves of 0.4 to 3 m length that reach about +-`amplitude` [m].

    The amplitude of each wave is proportional to its length, as on natural ground.
    """
    generator = torch.Generator().manual_seed(seed)
    length = torch.logspace(math.log10(0.4), math.log10(3.0), count, dtype=torch.float64)
    heading, phase = (2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64) for _ in range(2))
    # The peaks of random sines rarely meet: in practice the sum reaches 1.6 times its root sum of squares.
    height = length * amplitude / (1.6 * length.square().sum().sqrt())
    return Waves(height.tolist(), length.tolist(), heading.tolist(), phase.tolist())


def even_waves(generator: torch.Generator, amplitude: float, count: int = 4) -> Waves:
    """Draw waves of 1 to 4 m length, each of half the `amplitude` [m]."""
    length, heading, phase = torch.rand(count, 3, generator=generator).double().unbind(-1)
    turn = 2 * math.pi
    return Waves([amplitude / 2] * count, (1 + 3 * length).tolist(), (turn * heading).tolist(), (turn * phase).tolist())
