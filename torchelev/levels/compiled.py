"""What the compiled code of levels needs (`kernel/cpu.cpp`), for float32 maps on a CPU: the same as `step.py`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from torchelev.kernels.registry import Kernel
from torchelev.kernels.structs import Double, Settings
from torchelev.levels.config import LevelsConfig
from torchelev.levels.rays import SightGrid

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.config import ElevationMapConfig


class StoredLevels(NamedTuple):
    """The levels of B maps as updates change them: `Levels` in rings, L = K - 1."""

    corner: Int[Tensor, "B 2"]  #: cell numbers of the windows' corners
    lower: Float[Tensor, "B L H W"]  #: [m]
    upper: Float[Tensor, "B L H W"]  #: [m]
    variance: Float[Tensor, "B L H W"]  #: [m^2]
    support: Float[Tensor, "B L H W"]  #: points
    time: Float[Tensor, "B L H W"]  #: [s]
    free_top: Float[Tensor, "B H W"]  #: [m]
    is_open: Bool[Tensor, "B H W"]  #: whether rays passed close above the ground
    numbers: Int[Tensor, "B 5"]  #: what the last update did, in the order of `LevelStatistics`


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    own, overlap, size = cfg.levels or LevelsConfig(), cfg.overlap, SightGrid.of(cfg.grid)
    return dict(
        resolution=Double(cfg.grid.resolution),
        variance_rate=float(cfg.aging.variance_rate),
        max_variance=float(cfg.fusion.max_variance),
        max_support=float(cfg.fusion.max_support),
        variance_floor=float(cfg.fusion.scan_variance_floor),
        min_gap=float(own.min_gap),
        max_step=float(own.max_step),
        min_support=float(own.min_support),
        least_support=float(own.least_support),
        min_time=math.inf if cfg.raycast is None else float(cfg.raycast.min_time),
        overlap_height=0.0 if overlap is None else float(overlap.height),
        overlap_radius=0.0 if overlap is None else float(overlap.radius),
        by_gap=own.separation == "gap",
        max_blind=own.blind_cells(cfg.grid),
        azimuths=size.azimuths,
        elevations=size.elevations,
        ranges=size.ranges,
    )


KERNEL = Kernel(name="levels", folder="levels/kernel", settings=settings)
