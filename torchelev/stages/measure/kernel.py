"""What the compiled code of this stage needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.inputs.checks import FARTHEST
from torchelev.kernels.registry import Kernel, Launch, once, per_point
from torchelev.kernels.structs import Double, Settings
from torchelev.stages.measure.config import BodyConfig, ExclusionConfig

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def settings(cfg: ElevationMapConfig) -> Settings:
    """Return what the equations need of a config."""
    sensor, ramp = cfg.sensor, cfg.sensor.exclusion or ExclusionConfig()
    body = sensor.body if isinstance(sensor.body, BodyConfig) else BodyConfig()
    return dict(
        resolution=Double(cfg.grid.resolution),
        farthest=FARTHEST,
        noise_factor=float(sensor.noise_factor),
        noise_floor=float(sensor.noise_floor),
        min_square=float(sensor.min_distance**2),
        max_square=float(sensor.max_distance**2),
        max_distance=float(sensor.max_distance),
        has_ramp=sensor.exclusion is not None,
        ramp_slope=float(ramp.slope),
        ramp_distance=float(ramp.distance),
        ramp_offset=float(ramp.offset),
        ramp_height=float(ramp.height),
        has_box=isinstance(sensor.body, BodyConfig),
        box_lower=tuple(map(float, body.lower)),
        box_upper=tuple(map(float, body.upper)),
    )


KERNEL = Kernel(
    name="measure",
    folder="stages/measure",
    settings=settings,
    cuda={
        "measure": (Launch("place_measurement", once), Launch("measure_points", per_point)),
        "reset_statistics": (Launch("reset_statistics", once),),
    },
    scratch={
        "anchor": "int64_t B 2",
        "origin": "float B S 3",
        "base": "float B 3",
        "sound": "int32_t B",
        "dt": "float B",
        "x": "float B M",
        "y": "float B M",
        "z": "float B M",
        "noise": "float B M",
        "of_pose": "float B M",
        "used": "uint8_t B M",
        "casts": "uint8_t B M",
        "gated": "int64_t B 4",
    },
)
