"""Errors named by what they imitate. Numbers without a source are marked as chosen.

Presets combine: `depth_camera()._replace(pose=leg_odometry().pose)`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchelev.errors import require
from torchelev.sim.errors.error_models import SensorErrorConfig
from torchelev.sim.errors.pose_error import PoseErrorConfig


class ErrorPreset(NamedTuple):
    """What `SensorErrors` and `PoseErrors` take: a config each, or kinds of episodes as pairs (share, config)."""

    #: of all episodes, or kinds of episodes as pairs (share, config)
    sensor: SensorErrorConfig | Sequence[tuple[float, SensorErrorConfig]] = SensorErrorConfig()
    #: of all episodes, or kinds of episodes as pairs (share, config)
    pose: PoseErrorConfig | Sequence[tuple[float, PoseErrorConfig]] = PoseErrorConfig()


def perfect() -> ErrorPreset:
    """Return no errors."""
    return ErrorPreset()


def miki_2022() -> ErrorPreset:
    """Return kinds of episodes after Miki et al. 2022 (Science Robotics): 60 % nominal, 30 % offset, 10 % noisy.

    Numbers from a re-implementation, not checked against the paper, which disturbs height scans, not clouds: sigma of
    a point's x and y 0.004, z 0.005 / 0.005 / 0.1, of the scan around a foot x and y 0.01 / 0.01 / 0.1, z
    0.04 / 0.1 / 0.3, outliers 0.02 / 0.02 / 0.05 of sigma 0.03 / 0.1 / 0.3 [m]. Here a point's z is the noise of all
    its axes, and the scan's is white noise of the pose. Sensor and pose draw their kinds independently.
    """
    shares, points, outliers = (0.6, 0.3, 0.1), (0.005, 0.005, 0.1), ((0.02, 0.03), (0.02, 0.1), (0.05, 0.3))
    sensor = [
        (share, SensorErrorConfig(point_noise=sigma, outliers=outlier, outlier_noise=far))
        for share, sigma, (outlier, far) in zip(shares, points, outliers, strict=True)
    ]
    scans = ((0.01, 0.04), (0.01, 0.1), (0.1, 0.3))
    pose = [(share, PoseErrorConfig(noise_xy=xy, noise_z=z)) for share, (xy, z) in zip(shares, scans, strict=True)]
    return ErrorPreset(sensor, pose)


def ame_2() -> ErrorPreset:
    """Return the errors that AME-2 (2026) is said to train with: 15 % missing, 2 % artefacts, +-5 cm, +-3 cm drift.

    Chosen: the noise is normal with the sigma of an even +-5 cm, the artefacts are half too short and half too long,
    the drift is a random walk of z whose sigma after 20 s is that of an even +-3 cm. Its 1 % of corrupted cells and
    10 % of environments with complete maps are left out: they are no errors of a sensor.
    """
    sensor = SensorErrorConfig(dropout=0.15, too_short=0.01, too_long=0.01, point_noise=0.05 / 3**0.5)
    return ErrorPreset(sensor, PoseErrorConfig(drift_z_time=0.03 / 3**0.5 / 20**0.5))


def depth_camera() -> ErrorPreset:
    """Return a stereo depth camera like the Intel RealSense D435 at 848 x 480 pixels.

    The depth's sigma is subpixel * z^2 / (f b), here along the ray. Subpixel: 0.032 at best, about 0.08 in practice
    (the vendor in librealsense issue 3904); f = 424 pixels, as 848 of them see 90 degrees, and disparities in steps of
    1/32 pixel (Intel, "Subpixel linearity improvement"); b = 50 mm (Intel community, thread 676278). That makes 1.5 to
    3.8 mm at 1 m, where support says 2.5 to 5 (librealsense issue 7806), and 24 to 60 mm at 4 m. Chosen: flying
    pixels, losses, latency and mounting.
    """
    disparity = 1 / (424 * 0.05)  # [1/m] of one pixel
    sensor = SensorErrorConfig(
        range_quadratic=(0.032 * disparity, 0.08 * disparity),
        disparity_step=disparity / 32,
        flying=(0.2, 0.8),
        too_short=(0.0, 0.002),
        dropout=(0.01, 0.1),
        missed_frames=(0.0, 0.02),
        latency=(0, 2),
        mounting_position=0.005,
        mounting_rotation_deg=0.5,
    )
    return ErrorPreset(sensor)


def spinning_lidar() -> ErrorPreset:
    """Return a spinning lidar like the Ouster OS1.

    From its data sheet: range repeatability (1 sigma) 1.5 cm for strong returns to 3 cm for weaker ones, resolution
    1.2 cm, a false return in 10,000. Chosen: flying points, losses, latency and mounting.
    """
    sensor = SensorErrorConfig(
        range_constant=(0.015, 0.03),
        range_step=0.012,
        flying=(0.0, 0.3),
        too_short=1e-4,
        dropout=(0.01, 0.05),
        latency=(0, 1),
        mounting_position=0.005,
        mounting_rotation_deg=0.5,
    )
    return ErrorPreset(sensor)


def leg_odometry() -> ErrorPreset:
    """Return the drift of odometry from legs and an inertial sensor, without camera or lidar.

    Sun et al. 2026 (arXiv 2602.17393) close loops with quadrupeds: 0.16 m off after 200 m to 7.7 m after 700 m on the
    flat, with a Unitree Go2 2.2 m after 120 m; 0.22 m after 15 m and 0.54 m after 20 m up and down. Taken as the sigma
    of a random walk, d metres off after D are d / sqrt(D); on the flat that is shared by two axes. Vertical loops
    climb, so the drift of z on the flat is less. Chosen: the ranges' ends of z and yaw, and the noise.
    """
    pose = PoseErrorConfig(
        drift_xy_distance=(0.16 / (2 * 200) ** 0.5, 7.7 / (2 * 700) ** 0.5),
        drift_z_distance=(0.005, 0.22 / 15**0.5),
        drift_yaw_distance_deg=(0.0, 0.3),
        noise_xy=0.002,
        noise_z=0.002,
        noise_yaw_deg=0.05,
    )
    return ErrorPreset(pose=pose)


PRESETS: dict[str, Callable[[], ErrorPreset]] = {
    made.__name__: made for made in (perfect, miki_2022, ame_2, depth_camera, spinning_lidar, leg_odometry)
}


def preset(name: str) -> ErrorPreset:
    """Return a preset by name: `SensorErrors(preset("depth_camera").sensor, num_envs)`, `PoseErrors(... .pose, ...)`.

    Raises ValueError, naming them all, for another.
    """
    require(name in PRESETS, "name", f"must be one of {', '.join(PRESETS)}", repr(name), "use one of them")
    return PRESETS[name]()
