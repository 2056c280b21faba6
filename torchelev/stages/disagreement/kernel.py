"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel, Launch, per_cell
from torchelev.kernels.structs import Settings
from torchelev.stages.disagreement import stage

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    return dict(
        resolution=float(cfg.grid.resolution),
        significant_square=stage.SIGNIFICANT**2,
        newest=stage.NEWEST,
        max_bias=stage.MAX_BIAS,
        min_cells=stage.MIN_CELLS,
        least=stage.LEAST,
    )


KERNEL = Kernel(
    name="disagreement",
    folder="stages/disagreement",
    settings=settings,
    cuda={
        "subtract_disagreement": (Launch("subtract_disagreement", per_cell),),
        "add_disagreement": (Launch("add_disagreement", per_cell),),
    },
)
