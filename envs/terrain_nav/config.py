"""The settings of TerrainNav."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torchelev.errors import require
from torchelev.observations.fill import FILLS
from torchelev.sim import CourseConfig

PERCEPTION = ("map", "truth", "blind")
CEILINGS = ("none", "scan", "drop", "voxels")


@dataclass(frozen=True, kw_only=True)
class BodyConfig:
    """A base that follows velocity commands over the ground, and the limits of the ground it can cross."""

    length: float = 0.6  #: [m] of the footprint
    width: float = 0.4  #: [m] of the footprint
    body_height: float = 0.45  #: [m] of the base over the ground under its feet
    top: float = 0.6  #: [m] highest point of the body over the ground under its feet; boxes below it are hit
    max_speed: float = 1.0  #: [m/s] forward; a third of it backward
    max_yaw_rate: float = 1.5  #: [rad/s]
    response: float = 0.2  #: [s] time constant with which the velocity follows the command
    max_climb: float = 0.22  #: [m] ground higher than this above the feet blocks the robot
    max_drop: float = 0.3  #: [m] ground deeper than this below the feet is a fall
    reach: float = 0.1  #: [m] distance around the footprint within which ground can block the robot
    max_slope: float = 0.8  #: gradient at which the speed would be 0; it never falls below a fifth


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Weights of the terms of the reward; see `TerrainNav` for the formula."""

    progress: float = 1.0  #: per metre of progress towards the goal
    success: float = 5.0  #: once, when the robot reaches the goal
    fall: float = -5.0  #: once, when the robot falls
    stuck: float = -5.0  #: once, when the robot is stuck
    blocked: float = -0.1  #: per step in which the robot is blocked
    time: float = -0.02  #: per step
    action_rate: float = -0.01  #: per squared change of the action


@dataclass(frozen=True, kw_only=True)
class SightConfig:
    """The robot's depth cameras, its map, and the crop of the map that a policy reads."""

    resolution: float = 0.1  #: [m] of the map
    window: float = 6.0  #: [m] side of the map; must hold the crop at any heading
    crop_length: float = 3.2  #: [m] side of the crop, in the base's yaw frame
    crop_resolution: float = 0.2  #: [m] of the crop
    crop_ahead: float = 0.8  #: [m] from the base to the centre of the crop
    camera_yaws_deg: tuple[float, ...] = (45.0, -45.0)  #: [deg] heading of each depth camera, positive to the left
    camera_pixels: tuple[int, int] = (16, 16)  #: width and height of each camera's image
    camera_fov_deg: tuple[float, float] = (90.0, 60.0)  #: [deg] horizontal and vertical field of view
    camera_pitch_deg: float = 32.0  #: [deg] by which the cameras look down
    max_range: float = 5.0  #: [m] of the cameras
    sensor_errors: str = "depth_camera"  #: preset of torchelev.sim
    pose_errors: str = "leg_odometry"  #: preset of torchelev.sim
    truth_noise: float = 0.1  #: [m] amplitude of the uniform noise on the heights of perception "truth"
    #: what the elevation of perception "map" reads where the map is unknown, by the rules of `HeightScan`: "base" for
    #: the nominal ground below the base, "inpaint", ...; the validity always marks unknown cells
    fill: str = "base"
    #: what the image shows of ceilings, after its four layers: "none"; "scan", a height scan of the ceiling and its
    #: mask; "drop", the same as heights below `no_ceiling`; "voxels", what a `VoxelCrop` finds occupied. All but "none"
    #: give the map levels
    ceilings: str = "none"
    no_ceiling: float = 1.0  #: [m] above the base: the scan reads it where nothing hangs lower, or nobody looked

    def __post_init__(self) -> None:
        extent = 2 * math.hypot(self.crop_length / 2 + abs(self.crop_ahead), self.crop_length / 2)
        rule = f"must hold the crop at any heading, {extent:.2f} m and two cells"
        require(extent + 2 * self.resolution <= self.window, "sight.window", rule, self.window, "enlarge it")
        rule = f"must be one of {', '.join(FILLS)}"
        require(self.fill in FILLS, "sight.fill", rule, repr(self.fill), "use base")
        rule = f"must be one of {', '.join(CEILINGS)}"
        require(self.ceilings in CEILINGS, "sight.ceilings", rule, repr(self.ceilings), "use none")


@dataclass(frozen=True, kw_only=True)
class TerrainNavConfig:
    """All settings of the task."""

    course: CourseConfig = field(default_factory=CourseConfig)  #: the ground and the routes on it
    robot: BodyConfig = field(default_factory=BodyConfig)  #: how the robot moves
    reward: RewardConfig = field(default_factory=RewardConfig)  #: weights of the reward
    sight: SightConfig = field(default_factory=SightConfig)  #: what the robot sees
    dt: float = 0.2  #: [s] between actions
    substeps: int = 4  #: simulation steps in each `dt`
    episode_length: float = 20.0  #: [s] after which an episode is truncated
    goal_radius: float = 0.4  #: [m] distance within which the goal is reached
    stuck_after: float = 3.0  #: [s] of being blocked without interruption that end an episode

    def __post_init__(self) -> None:
        for name in ("dt", "substeps", "episode_length", "goal_radius", "stuck_after"):
            value = getattr(self, name)
            require(value > 0, name, "must be positive", value, "raise it")

    @property
    def max_episode_length(self) -> int:
        """Number of steps after which an episode is truncated."""
        return round(self.episode_length / self.dt)
