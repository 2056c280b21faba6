"""Noise model and gates of a sensor's points."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchelev.errors import require
from torchelev.robot_body.shapes import RobotBody
from torchelev.stages.by_tensors import ByTensors


@dataclass(frozen=True, kw_only=True)
class BodyConfig:
    """A box in the base frame that holds the robot; points inside are the robot's own."""

    lower: tuple[float, float, float] = (-0.4, -0.25, -0.2)  #: [m] x, y, z of the rear, right, lower corner
    upper: tuple[float, float, float] = (0.4, 0.25, 0.3)  #: [m] x, y, z of the front, left, upper corner


@dataclass(frozen=True, kw_only=True)
class ExclusionConfig:
    """The ramp of the paper's Fig. 3: points above it are overhangs, not ground."""

    slope: float = 0.3  #: tan(theta_a), the slope of the ramp
    distance: float = 1.0  #: [m] b: horizontal distance at which the ramp starts to rise
    offset: float = 0.2  #: [m] c: height above the sensor before b
    height: float = 1.0  #: [m] d: maximum height of the ramp above the sensor


@dataclass(frozen=True, kw_only=True)
class DepthConfig(ByTensors):
    """A camera's noise and ramp as elevation_mapping_cupy computes them. Uses tensor operations."""

    factor: float = 0.05  #: adds factor * z^2 to sigma_p^2, with z along the sensor's own z axis
    ramp_from_center: bool = True  #: measure the ramp's `distance` from the window's centre instead of the sensor

    def __post_init__(self) -> None:
        good, hint = 0 <= self.factor < math.inf, "give 0.05"
        require(good, "sensor.depth.factor", "must be finite and not negative", self.factor, hint)


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """Noise model and gates of the points."""

    noise_factor: float = 1e-4  #: alpha_d in sigma_p^2 = alpha_d * d^2 + noise_floor; default: 1 % of the distance
    noise_floor: float = 2.5e-5  #: [m^2] variance of a point at distance 0: (5 mm)^2
    min_distance: float = 0.1  #: [m] minimum distance of a point from the sensor
    max_distance: float = 50.0  #: [m] maximum distance of a point from the sensor
    #: ramp above which points are overhangs; None: every point is used
    exclusion: ExclusionConfig | None = ExclusionConfig()
    #: the robot's body, on which points are ignored: a box in the base frame, or the shapes of links; None: no body
    body: BodyConfig | RobotBody | None = None
    depth: DepthConfig | None = None  #: noise that grows with the depth; None: noise grows with the distance

    def __post_init__(self) -> None:
        require(self.noise_factor >= 0, "sensor.noise_factor", "must not be negative", self.noise_factor, "give 1e-4")
        require(self.noise_floor > 0, "sensor.noise_floor", "must be positive", self.noise_floor, "give 2.5e-5 m^2")
        ordered, actual = 0 <= self.min_distance < self.max_distance, (self.min_distance, self.max_distance)
        hint = "give 0 <= min < max in metres"
        require(ordered, "sensor.min_distance, max_distance", "must be ordered", actual, hint)
        is_body = self.body is None or isinstance(self.body, BodyConfig | RobotBody)
        hint = "give a box in the base frame, or the shapes of the links"
        require(is_body, "sensor.body", "must be a BodyConfig, a RobotBody or None", repr(self.body), hint, TypeError)

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the K links whose poses an update takes as `T_base_links`; none unless the body is a RobotBody."""
        return self.body.links if isinstance(self.body, RobotBody) else ()
