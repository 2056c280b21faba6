"""The settings of the quadruped task."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchelev.errors import require

PERCEPTION = ("map", "truth", "blind")
SENSORS = {"depth_cameras": "depth_camera", "lidar": "spinning_lidar"}  # and the presets of their errors


# What a robot meets that walks from the middle of a tile to its rim. The kinds of torchelev.sim are called by how the
# ground climbs towards the middle.
_LABELS = {"slope": "slopes", "stairs_up": "stairs down", "stairs_down": "stairs up"}


@dataclass(frozen=True, kw_only=True)
class TerrainConfig:
    """Tiles of each kind at each difficulty, side by side in one height field."""

    kinds: tuple[str, ...] = (
        "flat",
        "rough",
        "slope",
        "stairs_up",
        "stairs_down",
        "boxes",
        "gaps",
    )  #: of torchelev.sim; `labels` says what a robot meets there
    num_levels: int = 8  #: difficulties from the easiest to the hardest
    difficulty: tuple[float, float] = (0.0, 0.5)  #: of the first and last level: stairs of 5 to 14 cm
    length: float = 8.0  #: [m] side of a tile; a robot that leaves its tile has crossed it
    resolution: float = 0.05  #: [m] between the samples of the height field
    rim: float = 0.4  #: [m] the tile counts as crossed this far before its rim
    start_level: int = 2  #: new robots begin at levels below this
    curriculum: bool = True  #: robots that cross their tile move to the next level; False: levels are drawn evenly
    seed: int = 0  #: the same seed makes the same tiles

    @property
    def labels(self) -> tuple[str, ...]:
        """What a robot meets on each kind, as it starts in the middle of a tile: it climbs "stairs up"."""
        return tuple(_LABELS.get(kind, kind) for kind in self.kinds)


@dataclass(frozen=True, kw_only=True)
class GaitConfig:
    """The trot that actions modify: foot positions over a clock, after Lee et al. 2020 (Science Robotics)."""

    frequency: float = 2.0  #: [Hz] of a full cycle
    duty: float = 0.6  #: fraction of a cycle for which a foot stands
    swing_height: float = 0.07  #: [m] by which a swinging foot is lifted
    body_height: float = 0.30  #: [m] of the base over the feet
    action_scale: tuple[float, float, float] = (0.08, 0.05, 0.08)  #: [m] by which an action of 1 moves a foot
    max_action: float = 3.0  #: actions are clipped to +-max_action


@dataclass(frozen=True, kw_only=True)
class CommandConfig:
    """Velocity commands. The yaw rate turns the robot towards a heading, as in legged_gym."""

    forward: tuple[float, float] = (0.2, 0.7)  #: [m/s] (min, max)
    left: tuple[float, float] = (-0.1, 0.1)  #: [m/s] (min, max)
    heading: float = 0.5  #: [rad] largest change of heading when a new command is drawn
    heading_gain: float = 0.8  #: [1/s] yaw rate per heading error
    max_yaw_rate: float = 0.8  #: [rad/s]
    interval: float = 8.0  #: [s] mean time between commands
    standing: float = 0.05  #: fraction of commands to stand still


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Weights of the terms of the reward; `rewards.py` gives each term's formula."""

    linear_velocity: float = 2.0
    yaw_rate: float = 0.8
    vertical_velocity: float = -0.3
    roll_pitch_rate: float = -0.02
    orientation: float = -0.5
    torque: float = -1e-4
    joint_acceleration: float = -5e-8
    action_rate: float = -0.01
    action: float = -0.005
    collision: float = -0.5
    slip: float = -0.1
    fall: float = -2.0  #: once; the other terms are per second
    tracking_sigma: float = 0.4  #: [m/s], [rad/s] error at which tracking rewards fall to 1/e


@dataclass(frozen=True, kw_only=True)
class RandomConfig:
    """Domain randomisation. Bodies are drawn once; every episode gets one of them."""

    num_bodies: int = 8  #: different robots
    friction: tuple[float, float] = (0.5, 1.2)  #: of the feet
    payload: tuple[float, float] = (-1.0, 2.0)  #: [kg] added to the base
    center_of_mass: float = 0.03  #: [m] largest displacement of the base's, along each axis
    strength: tuple[float, float] = (0.9, 1.1)  #: factor on the joints' stiffness and damping
    max_latency: int = 2  #: [physics steps] by which joint targets arrive late, at most
    push: float = 0.5  #: [m/s] largest change of the base's velocity by a push, along x and y
    push_interval: float = 8.0  #: [s] mean time between pushes
    joint_noise: float = 0.01  #: [rad] half the width of the noise of joint encoders
    joint_velocity_noise: float = 0.8  #: [rad/s] the same of joint velocities
    gyro_noise: float = 0.15  #: [rad/s] of angular velocity
    gravity_noise: float = 0.03  #: of the direction of gravity


@dataclass(frozen=True, kw_only=True)
class OdometryConfig:
    """Leg odometry: it assumes that feet on the ground do not move."""

    velocity_noise: float = 0.03  #: [m/s] of each step's velocity
    scale_error: float = 0.02  #: largest relative error of the distance walked, drawn for each episode
    yaw_drift: float = 0.005  #: [rad] of the heading after 1 s, as a random walk
    height_drift: float = 0.005  #: [m] of z after 1 s, as a random walk


@dataclass(frozen=True, kw_only=True)
class SightConfig:
    """The robot's sensors, its map, and what policies read of it."""

    sensors: str = "depth_cameras"  #: "depth_cameras", one ahead and one behind, or "lidar", on the back
    camera_pixels: tuple[int, int] = (20, 16)  #: width and height of each camera's image
    camera_fov_deg: tuple[float, float] = (87.0, 58.0)  #: [deg] horizontal and vertical
    camera_pitch_deg: float = 45.0  #: [deg] by which the cameras look down
    max_range: float = 3.0  #: [m]
    #: preset of torchelev.sim; None: "depth_camera" for cameras, "spinning_lidar" for the lidar
    sensor_errors: str | None = None
    #: [m], [deg] standard deviations of the cameras' place on the robot, as a calibration against the legs leaves them
    mounting_error: tuple[float, float] = (0.001, 0.1)
    resolution: float = 0.05  #: [m] of the map
    window: float = 2.2  #: [m] side of the map, which holds the scan at any heading
    map_every: int = 4  #: policy steps between two updates of the map: 12.5 Hz
    rings: tuple[tuple[float, int], ...] = ((0.06, 6), (0.12, 8))  #: radius [m] and points of the rings around a foot
    fill: str = (
        "upper_bound"  #: what scans read over unknown cells, see `ScanSettings`; "ground" takes ten times as long
    )
    truth_noise: bool = True  #: perception "truth" reads heights with the noise of Miki et al. 2022

    def __post_init__(self) -> None:
        rule = f"must be one of {', '.join(SENSORS)}"
        require(self.sensors in SENSORS, "sight.sensors", rule, self.sensors, "choose one")
        fits = (self.sensors, self.sensor_errors) != ("lidar", "depth_camera")
        rule = "must not be those of a camera if sensors='lidar'"
        require(fits, "sight.sensor_errors", rule, repr(self.sensor_errors), "leave it out, or use 'spinning_lidar'")


@dataclass(frozen=True, kw_only=True)
class QuadrupedConfig:
    """All settings of the task."""

    terrain: TerrainConfig = field(default_factory=TerrainConfig)  #: the ground
    gait: GaitConfig = field(default_factory=GaitConfig)  #: the trot that actions modify
    command: CommandConfig = field(default_factory=CommandConfig)  #: what the robot is asked to do
    reward: RewardConfig = field(default_factory=RewardConfig)  #: weights of the reward
    random: RandomConfig = field(default_factory=RandomConfig)  #: domain randomisation
    odometry: OdometryConfig = field(default_factory=OdometryConfig)  #: errors of the estimated pose
    sight: SightConfig = field(default_factory=SightConfig)  #: what the robot sees
    substeps: int = 4  #: physics steps of 5 ms in a policy step
    episode_length: float = 20.0  #: [s] after which an episode is truncated
    max_tilt: float = 1.0  #: [rad] inclination of the base beyond which the robot has fallen

    def __post_init__(self) -> None:
        for name in ("substeps", "episode_length", "max_tilt"):
            value = getattr(self, name)
            require(value > 0, name, "must be positive", value, "raise it")

    @property
    def dt(self) -> float:
        """Time [s] between two actions."""
        return 0.005 * self.substeps

    @property
    def max_episode_length(self) -> int:
        """Number of steps after which an episode is truncated."""
        return round(self.episode_length / self.dt)
