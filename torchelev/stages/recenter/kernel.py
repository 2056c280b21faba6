"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.kernels.registry import Kernel, Launch, once, per_point
from torchelev.kernels.structs import Settings

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    return dict(resolution=float(cfg.grid.resolution))


LOCATE = Launch("clear_located", once), Launch("locate_points", per_point)
KERNEL = Kernel(
    name="recenter",
    folder="stages/recenter",
    settings=settings,
    cuda={
        "recenter": (
            Launch("find_shift", once),
            Launch("move_layers", lambda sizes: 14 * sizes.B, threads=512),
            *LOCATE,
        ),
        "locate": LOCATE,
    },
    scratch={"shift": "int64_t B 2", "slot": "int32_t B M", "located": "int64_t B 2"},
)
