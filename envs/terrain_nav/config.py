"""The settings of TerrainNav, all in one place, so that an experiment is fixed before its first run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torchelev.errors import require
from torchelev.sim import CourseConfig

PERCEPTION = ("map", "truth", "blind")


@dataclass(frozen=True, kw_only=True)
class BodyConfig:
    """A base that follows velocity commands over the ground, and where it cannot."""

    length: float = 0.6  # [m] of the footprint
    width: float = 0.4  # [m]
    body_height: float = 0.45  # [m] of the base over the ground under its feet
    max_speed: float = 1.0  # [m/s] forward; a third of it backward
    max_yaw_rate: float = 1.5  # [rad/s]
    response: float = 0.2  # [s] in which the velocity follows the command
    max_climb: float = 0.22  # [m] ground this much above the feet blocks the way
    max_drop: float = 0.3  # [m] ground this much below the feet is a fall
    reach: float = 0.1  # [m] around the footprint in which ground blocks the way
    max_slope: float = 0.8  # gradient towards which the speed falls, to a fifth of what it is on the level


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Weights of the reward's terms; see `TerrainNav` for the formula."""

    progress: float = 1.0  # per metre towards the goal
    success: float = 5.0
    fall: float = -5.0
    stuck: float = -5.0
    blocked: float = -0.1  # per step
    time: float = -0.02  # per step
    action_rate: float = -0.01  # per squared change of the action


@dataclass(frozen=True, kw_only=True)
class SightConfig:
    """What the robot sees: its map, and the crop of it that a policy reads."""

    resolution: float = 0.1  # [m] of the map
    window: float = 6.0  # [m] side of the map
    crop_length: float = 3.2  # [m] side of the crop, in the base's yaw frame
    crop_resolution: float = 0.2  # [m]
    crop_ahead: float = 0.8  # [m] of the crop's middle before the base
    camera_yaws_deg: tuple[float, ...] = (45.0, -45.0)  # where each depth camera looks, counted from ahead
    camera_pixels: tuple[int, int] = (16, 16)  # width, height of each
    camera_fov_deg: tuple[float, float] = (90.0, 60.0)
    camera_pitch_deg: float = 32.0  # downwards
    max_range: float = 5.0  # [m]
    sensor_errors: str = "depth_camera"  # a preset of torchelev.sim
    pose_errors: str = "leg_odometry"  # a preset of torchelev.sim
    truth_noise: float = 0.1  # [m] uniform, each way, on the heights of perception "truth"

    def __post_init__(self) -> None:
        reach = 2 * math.hypot(self.crop_length / 2 + abs(self.crop_ahead), self.crop_length / 2)
        rule = f"must hold the crop at any heading, {reach:.2f} m and two cells"
        require(reach + 2 * self.resolution <= self.window, "sight.window", rule, self.window, "enlarge it")


@dataclass(frozen=True, kw_only=True)
class TerrainNavConfig:
    """Everything about the task."""

    course: CourseConfig = field(default_factory=CourseConfig)
    robot: BodyConfig = field(default_factory=BodyConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    sight: SightConfig = field(default_factory=SightConfig)
    dt: float = 0.2  # [s] between actions
    substeps: int = 4
    episode_length: float = 20.0  # [s]
    goal_radius: float = 0.4  # [m]
    stuck_after: float = 3.0  # [s] of being blocked without a break

    def __post_init__(self) -> None:
        for name in ("dt", "substeps", "episode_length", "goal_radius", "stuck_after"):
            value = getattr(self, name)
            require(value > 0, name, "must be positive", value, "see its default")

    @property
    def max_episode_length(self) -> int:
        """Steps after which an episode is truncated."""
        return round(self.episode_length / self.dt)
