"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel
from torchelev.kernels.structs import Settings
from torchelev.ops.masks import NOWHERE
from torchelev.plane_fit import MIN_DET, MIN_TRACE, min_spread
from torchelev.traversability.heads import TraversabilityConfig, step_cells

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    head = cfg.traversability if isinstance(cfg.traversability, TraversabilityConfig) else None
    radius, cells = cfg.surface.radius, 0 if head is None else head.cells(cfg.grid)
    critical = (1.0, 1.0, 1.0) if head is None else head.critical
    return dict(
        radius=radius,
        cells=cells,
        steps=min(cells, step_cells(cfg.grid.resolution)),
        has_no_head=cfg.traversability is None,
        per_cell=1 / cfg.grid.resolution,
        min_spread=(min_spread(radius), min_spread(cells)),
        per_critical=tuple(1 / value for value in critical),
        min_det=MIN_DET,
        min_trace=MIN_TRACE,
        nowhere=NOWHERE,
    )


KERNEL = Kernel(name="surface", folder="stages/surface", settings=settings)
