"""Windows over synthetic ground for the benchmarks of sites: maps whose state is filled, without casting rays."""

from __future__ import annotations

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig

RESOLUTION = 0.1  # [m]
_STD, _NOISE = (0.005, 0.015), 0.003  # [m] what the maps claim, and what their heights have
_OFFSET = 0.1  # [m] the robots' heights are wrong by as much at most, each by its own


def ground(x: Tensor, y: Tensor) -> Tensor:
    """Return the height of smooth hills [m]."""
    return 0.3 * torch.sin(0.3 * x) * torch.cos(0.2 * y) + 2.0 * torch.sin(0.02 * x) * torch.sin(0.03 * y)


class Windows:
    """Maps of B robots whose windows are put anywhere, and then know all of the ground there.

    Args:
        num_robots: B.
        cells: along each side of a window.

    Attributes:
        emap: the maps.
        offsets: (B,) [m] how much each robot's heights are wrong.
    """

    def __init__(self, num_robots: int, cells: int) -> None:
        length = cells * RESOLUTION
        grid = GridConfig(resolution=RESOLUTION, length_x=length, length_y=length)
        self.emap = ElevationMap(ElevationMapConfig(grid=grid), num_robots)
        self._generator = torch.Generator().manual_seed(0)
        self.offsets = _OFFSET * (2 * torch.rand(num_robots, generator=self._generator) - 1)

    @torch.inference_mode()
    def look(self, corner: Tensor, seconds: float = 1.0) -> None:
        """Let time pass, move the windows to corners (B, 2) [cells], and measure all of their cells."""
        state = self.emap.state
        state.corner.copy_(corner)
        state.validity.fill_(True)
        state.has_normal.fill_(True)
        state.elapsed.add_(round(1e9 * seconds))
        for robot in range(len(corner)):  # one after the other, so that what is computed takes little memory
            self._measure(robot, seconds)

    def _measure(self, robot: int, seconds: float) -> None:
        state, generator = self.emap.state, self._generator
        first, size = state.corner[robot], state.elevation.shape[1:]
        x, y = (RESOLUTION * (torch.arange(n) + first[axis] + 0.5) for axis, n in enumerate(size))
        x, y = x[:, None], y[None, :]
        noise = _NOISE * torch.randn(size, generator=generator)
        state.elevation[robot] = ground(x, y) + self.offsets[robot] + noise
        low, high = _STD
        state.variance[robot] = (low + (high - low) * torch.rand(size, generator=generator)).square()
        state.time[robot] = 0.9 * seconds * torch.rand(size, generator=generator)
        step = RESOLUTION / 2
        state.gradient_x[robot] = (ground(x + step, y) - ground(x - step, y)) / (2 * step)
        state.gradient_y[robot] = (ground(x, y + step) - ground(x, y - step)) / (2 * step)


def lattice(num_robots: int, spacing: int) -> Tensor:
    """Return the corners (B, 2) [cells] of windows side by side on a square lattice."""
    per_side = max(1, round(num_robots**0.5))
    number = torch.arange(num_robots)
    return spacing * torch.stack([number // per_side, number % per_side], 1)
