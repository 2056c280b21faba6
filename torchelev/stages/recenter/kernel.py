"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel
from torchelev.kernels.structs import Settings

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    return dict(resolution=float(cfg.grid.resolution))


KERNEL = Kernel(name="recenter", folder="stages/recenter", settings=settings)
