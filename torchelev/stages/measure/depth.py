"""Noise that grows with the depth, and a ramp that rises from the middle of the window."""

from __future__ import annotations

import torch
from torch import Tensor

from torchelev.stages.measure.config import DepthConfig


def add_depth_noise(variance: Tensor, z: Tensor, cfg: DepthConfig | None) -> Tensor:
    """Return the variance [m^2] of points at depths z [m], sigma_p^2 + factor * z^2."""
    return variance if cfg is None else variance + cfg.factor * z * z


def from_ramp(
    position: Tensor, relative: Tensor, base: Tensor | None, cfg: DepthConfig | None, resolution: float
) -> Tensor:
    """Return places (B, M, 3) [m] as the ramp counts them: `relative` to the sensor, or to the window's centre.

    Heights count from the sensor. The window is centred on the base to within half a cell; without one, on the sensor.
    """
    if base is None or cfg is None or not cfg.ramp_from_center:
        return relative
    center = torch.round(base[:, :2] / resolution) * resolution
    return torch.cat([position[..., :2] - center[:, None], relative[..., 2:]], -1)
