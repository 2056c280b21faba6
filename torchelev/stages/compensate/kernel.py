"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel, Launch, block_sums, per_cell, per_map
from torchelev.kernels.structs import Settings
from torchelev.ops.masks import NOWHERE
from torchelev.stages.compensate.config import DriftConfig

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    drift = cfg.drift or DriftConfig()
    return dict(
        has_drift=cfg.drift is not None,
        resolution=float(cfg.grid.resolution),
        min_traversability=float(cfg.drift_gate),
        max_variance=float(drift.max_variance),
        max_error=float(drift.max_error),
        gate_square=float(drift.gate**2),
        relief_square=float(drift.relief**2),
        min_points=drift.min_points,
        max_drift=float(drift.max_drift),
        gain=float(drift.gain),
        nowhere=NOWHERE,
    )


KERNEL = Kernel(
    name="compensate",
    folder="stages/compensate",
    settings=settings,
    cuda={
        "compensate": (
            Launch("clear_sums", lambda sizes: per_cell(sizes) * sizes.P),
            Launch("sum_heights", lambda sizes: per_map(sizes) if sizes.P else 0, threads=512, memory=block_sums),
            Launch("compare_sensors", lambda sizes: per_map(sizes) if sizes.P else 0, threads=512, memory=block_sums),
            Launch("find_drift", per_map, threads=512, memory=block_sums),
            Launch("share_pose_error", per_map, threads=512, memory=block_sums),
            Launch("shift_heights", per_cell),
        )
    },
    scratch={
        "sensor_number": "float B P H W",
        "sensor_moment": "float B P H W",
        "error": "float B M",
        "correction": "float B",
        "shared": "float B",
    },
)
