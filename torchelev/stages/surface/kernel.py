"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchelev.kernels.registry import Kernel, Launch
from torchelev.kernels.structs import Settings
from torchelev.ops.masks import NOWHERE
from torchelev.plane_fit import MIN_DET, MIN_TRACE, min_spread
from torchelev.traversability.heads import TraversabilityConfig, step_cells

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


TILE = 16, 32  # rows and columns of cells that a block of a GPU's threads rates, as in cuda.cu
_MEMORY = 48 * 2**10  # [bytes] that the threads of a block may share on every GPU


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    head = cfg.traversability if isinstance(cfg.traversability, TraversabilityConfig) else None
    radius, cells = cfg.surface.radius, 0 if head is None else head.cells(cfg.grid)
    critical = (1.0, 1.0, 1.0) if head is None else head.critical
    return dict(
        radius=radius,
        cells=cells,
        steps=min(cells, step_cells(cfg.grid.resolution)),
        per_cell=1 / cfg.grid.resolution,
        min_spread=(min_spread(radius), min_spread(cells)),
        per_critical=tuple(1 / value for value in critical),
        min_det=MIN_DET,
        min_trace=MIN_TRACE,
        nowhere=NOWHERE,
        tile_memory=tile_memory(max(radius, cells)),
    )


def tile_memory(rim: int) -> int:
    """Return the memory [bytes] of a tile's heights and of a rim around them; 0 if a block may not have it."""
    rows, columns = (size + 2 * rim for size in TILE)
    memory = 4 * rows * columns
    return memory if memory <= _MEMORY else 0


def per_tile(sizes: Any) -> int:
    """Return a block for each tile of each map."""
    return int(sizes.B * -(-sizes.H // TILE[0]) * -(-sizes.W // TILE[1]))


RATE = Launch("rate_surface", per_tile, threads=512, memory=lambda sizes, settings: int(settings.surface.tile_memory))
KERNEL = Kernel(name="surface", folder="stages/surface", settings=settings, cuda={"rate_surface": (RATE,)})
