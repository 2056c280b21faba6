"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchelev.kernels.registry import Kernel, Launch, once, per_map
from torchelev.kernels.structs import Settings
from torchelev.ops.masks import NOWHERE
from torchelev.stages.visibility.accepted_rays import CLEARANCE, NEAR
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.horizon import NO_FALL
from torchelev.stages.visibility.lowest_rays import NO_RAY
from torchelev.stages.visibility.polar_table import PolarGrid

MAX_LEVELS = 16  # that a table may be widened by

CELLS_AT_A_TIME = 16  # that a GPU's thread counts

if TYPE_CHECKING:
    from collections.abc import Callable

    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    rays = cfg.raycast or RaycastConfig()
    polar, size = PolarGrid.of(cfg.grid, rays), cfg.grid.resolution
    return dict(
        has_rays=cfg.raycast is not None,
        resolution=float(size),
        relief=float((0.5 * size) ** 2),
        min_time=float(rays.min_time),
        min_incidence=float(rays.min_incidence),
        min_support=float(rays.min_support),
        gate=float(rays.gate),
        ranges=polar.ranges,
        azimuths=polar.azimuths,
        bins=float(polar.bins),
        levels=len(polar.widen),
        widen=(*polar.widen, *[0] * (MAX_LEVELS - len(polar.widen))),
        horizon_ranges=polar.horizon_ranges,
        near_cells=max(1, int(NEAR / size)),
        clearance=CLEARANCE,
        no_ray=NO_RAY,
        no_fall=NO_FALL,
        nowhere=NOWHERE,
    )


def sizes(cfg: ElevationMapConfig) -> dict[str, int]:
    """Return the sizes of the tables by range and azimuth, and of the borders; zeros without rays."""
    rays, grid = cfg.raycast, cfg.grid
    polar = PolarGrid(0, 0, 0.0, ()) if rays is None else PolarGrid.of(grid, rays)
    return dict(
        has_rays=int(rays is not None),
        ranges=polar.ranges,
        azimuths=polar.azimuths,
        horizon_ranges=polar.horizon_ranges,
        horizon_azimuths=polar.horizon_azimuths,
        border=max(grid.height, grid.width),
    )


def table_memory(sizes: Any, settings: Any = None) -> int:
    """Return the memory [bytes] of a map's table."""
    return int(4 * sizes.ranges * sizes.azimuths)


def in_blocks(sizes: Any) -> bool:
    """Return whether a block for each map, with a table in its own memory, gives the GPU enough work."""
    return table_memory(sizes) <= sizes.block_memory and 2 * sizes.B >= sizes.processors


def at_large(number: Callable[[Any], int]) -> Callable[[Any], int]:
    """Return what returns blocks of 256 threads, one for each of so many in each map; none where blocks do it all."""
    return lambda sizes: 0 if in_blocks(sizes) else per(number)(sizes)


def per(number: Callable[[Any], int]) -> Callable[[Any], int]:
    """Return what returns blocks of 256 threads, one for each of so many in each map, by the sizes."""
    return lambda sizes: int(sizes.B * sizes.has_rays * -(-number(sizes) // 256))


KERNEL = Kernel(
    name="visibility",
    folder="stages/visibility",
    settings=settings,
    cuda={
        "clear_seen_through": (
            Launch("find_horizon", per(lambda sizes: sizes.horizon_azimuths)),
            Launch("find_borders", lambda sizes: 4 * per_map(sizes) * sizes.has_rays),
            Launch("apply_rays", lambda sizes: per_map(sizes) * sizes.has_rays * in_blocks(sizes), 512, table_memory),
            Launch("clear_table", at_large(lambda sizes: sizes.ranges * sizes.azimuths)),
            Launch("put_rays", at_large(lambda sizes: sizes.N)),
            Launch("scan_table", at_large(lambda sizes: sizes.azimuths)),
            Launch("clear_and_bound", at_large(lambda sizes: sizes.H * sizes.W)),
        ),
        "count_bounded": (
            Launch("start_count", once),
            Launch("count_bounded", lambda sizes: sizes.B * -(-sizes.H * sizes.W // (256 * CELLS_AT_A_TIME))),
        ),
    },
    per_sensor=("clear_seen_through",),
    sizes=sizes,
    scratch={
        "steepest": "float B horizon_ranges horizon_azimuths",
        "border_minima": "float B 4 border",
        "borders": "float B 4 border",
        "slopes": "int32_t B ranges azimuths",  # in the order of floats
    },
    unused=lambda sizes: ("slopes",) if in_blocks(sizes) else (),
)
