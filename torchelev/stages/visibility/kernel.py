"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel
from torchelev.kernels.structs import Settings
from torchelev.ops.masks import NOWHERE
from torchelev.stages.visibility.accepted_rays import CLEARANCE, NEAR
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.horizon import NO_FALL
from torchelev.stages.visibility.lowest_rays import NO_RAY
from torchelev.stages.visibility.polar_table import PolarGrid

MAX_LEVELS = 16  # that a table may be widened by

if TYPE_CHECKING:
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
        horizon_ranges=8 * (polar.ranges // 16 + 1),
        near_cells=max(1, int(NEAR / size)),
        clearance=CLEARANCE,
        no_ray=NO_RAY,
        no_fall=NO_FALL,
        nowhere=NOWHERE,
    )


KERNEL = Kernel(name="visibility", folder="stages/visibility", settings=settings)
