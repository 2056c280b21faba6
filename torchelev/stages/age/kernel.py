"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel, Launch, per_cell
from torchelev.kernels.structs import Settings

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    return dict(variance_rate=float(cfg.aging.variance_rate))


KERNEL = Kernel(name="age", folder="stages/age", settings=settings, cuda={"age": (Launch("age", per_cell),)})
