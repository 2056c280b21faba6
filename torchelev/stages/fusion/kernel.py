"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchelev.kernels.registry import Kernel, Launch, per_cell, per_point
from torchelev.kernels.structs import Settings
from torchelev.stages.fusion.challenge import MIN_CHALLENGERS
from torchelev.stages.fusion.config import EdgeConfig

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


MANY_POINTS = 2**20  # of all maps, above which eight threads of a GPU share a cell with many points, else a warp


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    fusion, edges = cfg.fusion, cfg.fusion.edges or EdgeConfig(margin=0.0, min_settled=0.0)
    return dict(
        resolution=float(cfg.grid.resolution),
        relief=float(fusion.relief * cfg.grid.resolution),
        gate=float(fusion.gate),
        max_gate_std=float(fusion.max_gate_std),
        floor=float(fusion.scan_variance_floor),
        outlier_variance=float(fusion.outlier_variance),
        max_support=float(fusion.max_support),
        max_variance=float(fusion.max_variance),
        min_above=fusion.min_above,
        max_above_per_scan=fusion.max_above_per_scan,
        min_challengers=MIN_CHALLENGERS,
        has_rays=cfg.raycast is not None,
        has_edges=fusion.edges is not None,
        min_points=edges.min_points,
        min_extreme=edges.min_extreme,
        refinements=edges.refinements,
        min_share=float(edges.min_share),
        min_passed=float(edges.min_passed),
        margin=float(edges.margin),
        min_settled=float(edges.min_settled),
        many_points=MANY_POINTS,
    )


def per_hit_cell(sizes: Any) -> int:
    """Return blocks of 256 threads, one for each cell that may be hit; a map's begin with a block."""
    return int(sizes.B * -(-min(sizes.M, sizes.H * sizes.W) // 256))


KERNEL = Kernel(
    name="fusion",
    folder="stages/fusion",
    settings=settings,
    cuda={
        "fuse": (
            Launch("clear_hits", per_cell),
            Launch("count_hits", per_point),
            Launch("list_hit_cells", per_point),
            Launch("sort_hits", per_point),
            Launch("find_consensus", per_hit_cell),
            Launch("resolve_special", per_hit_cell),
            Launch("update_cells", per_hit_cell),
        )
    },
    scratch={
        "hit_numbers": "int32_t B 3",
        "hit_count": "int32_t B H W",
        "hit_start": "int32_t B H W",
        "hit_mean": "float B H W",
        "hit_rank": "int32_t B M",
        "hits": "float B M 8",  # `SortedPoint`s
        "hit_cell": "int32_t B M",
        "hit_height": "float B M",
        "hit_variance": "float B M",
        "hit_marks": "uint8_t B M",
        "hit_support": "uint8_t B M",
    },
)
