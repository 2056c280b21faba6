"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel, Launch, block_sums, per_map, per_row
from torchelev.kernels.structs import Settings
from torchelev.stages.overlap.config import OverlapConfig
from torchelev.stages.overlap.stage import STANCE, near_part

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    overlap = cfg.overlap or OverlapConfig()
    first_row, end_row, first_column, end_column = near_part(cfg.grid, overlap)
    return dict(
        has_overlap=cfg.overlap is not None and not cfg.has_levels,
        resolution=float(cfg.grid.resolution),
        radius_square=float(overlap.radius**2),
        slope=float(overlap.height / overlap.radius),
        height=float(overlap.height),
        base_height=float(overlap.base_height),
        max_base_height=float(overlap.max_base_height),
        stance_square=STANCE**2,
        first_row=first_row,
        end_row=end_row,
        first_column=first_column,
        end_column=end_column,
    )


KERNEL = Kernel(
    name="overlap",
    folder="stages/overlap",
    settings=settings,
    cuda={
        "clear_other_floors": (
            Launch("sum_rows_below", per_row),
            Launch("find_floor", per_map, memory=block_sums),
            Launch("clear_other_floors", per_row),
        )
    },
    scratch={"near_rows": "float B H 7", "floor": "float B 2"},
)
