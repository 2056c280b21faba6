"""Presets of sensor and pose errors, named after what they imitate. Values without a source are marked as chosen.

Presets combine: `preset("depth_camera")._replace(pose=preset("leg_odometry").pose)`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchelev.errors import require
from torchelev.sim.errors.error_models import SensorErrorConfig
from torchelev.sim.errors.pose_error import PoseErrorConfig


class ErrorPreset(NamedTuple):
    """The configs that `SensorErrors` and `PoseErrors` take."""

    #: errors of the sensor: one config, or kinds of episodes as pairs (share, config)
    sensor: SensorErrorConfig | Sequence[tuple[float, SensorErrorConfig]] = SensorErrorConfig()
    #: errors of the estimated pose: one config, or kinds of episodes as pairs (share, config)
    pose: PoseErrorConfig | Sequence[tuple[float, PoseErrorConfig]] = PoseErrorConfig()


def _perfect() -> ErrorPreset:
    """Return no errors."""
    return ErrorPreset()


def _miki_2022() -> ErrorPreset:
    """Return the noise of Miki et al. 2022 (Science Robotics): episodes are 60 % nominal, 30 % offset, 10 % noisy.

    The values come from a re-implementation and are not checked against the paper. There they disturb height scans, in
    the order nominal / offset / noisy: each point by a sigma [m] of 0.004 in x and y and of 0.005 / 0.005 / 0.1 in z,
    the scan around a foot by 0.01 / 0.01 / 0.1 in x and y and by 0.04 / 0.1 / 0.3 in z; a fraction 0.02 / 0.02 / 0.05
    are outliers with a sigma of 0.03 / 0.1 / 0.3. Here clouds and poses are disturbed: all axes of a point get the
    noise of its z, and the pose gets the scan's as white noise. Sensor and pose draw their kinds independently.
    """
    shares, points, outliers = (0.6, 0.3, 0.1), (0.005, 0.005, 0.1), ((0.02, 0.03), (0.02, 0.1), (0.05, 0.3))
    sensor = [
        (share, SensorErrorConfig(point_noise=sigma, outliers=outlier, outlier_noise=far))
        for share, sigma, (outlier, far) in zip(shares, points, outliers, strict=True)
    ]
    scans = ((0.01, 0.04), (0.01, 0.1), (0.1, 0.3))
    pose = [(share, PoseErrorConfig(noise_xy=xy, noise_z=z)) for share, (xy, z) in zip(shares, scans, strict=True)]
    return ErrorPreset(sensor, pose)


def _ame_2() -> ErrorPreset:
    """Return the errors reported for the training of AME-2 (2026): 15 % lost points, 2 % artefacts, noise and drift.

    Reported are +-5 cm of noise and +-3 cm of drift. Chosen: normal noise with the sigma of a uniform +-5 cm, half of
    the artefacts too short and half too long, and as drift a random walk of z whose sigma after 20 s is that of a
    uniform +-3 cm. The 1 % of corrupted cells and the 10 % of environments with complete maps are left out, as they
    are not sensor errors.
    """
    sensor = SensorErrorConfig(dropout=0.15, too_short=0.01, too_long=0.01, point_noise=0.05 / 3**0.5)
    return ErrorPreset(sensor, PoseErrorConfig(drift_z_time=0.03 / 3**0.5 / 20**0.5))


def _depth_camera() -> ErrorPreset:
    """Return a stereo depth camera like the Intel RealSense D435 at 848 x 480 pixels.

    The sigma of the depth is subpixel * z^2 / (f b), here along the ray. Subpixel error: 0.032 at best, about 0.08 in
    practice (the vendor in librealsense issue 3904). Focal length: f = 424 pixels, from 848 pixels over 90 degrees.
    Disparity: in steps of 1/32 pixel (Intel, "Subpixel linearity improvement"). Baseline: b = 50 mm (Intel community,
    thread 676278). This gives 1.5 to 3.8 mm at 1 m, where the vendor's support says 2.5 to 5 mm (librealsense issue
    7806), and 24 to 60 mm at 4 m. Chosen: flying pixels, losses, latency and mounting.
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


def _spinning_lidar() -> ErrorPreset:
    """Return a spinning lidar like the Ouster OS1.

    From its data sheet: range repeatability (1 sigma) of 1.5 cm for strong returns to 3 cm for weak ones, a resolution
    of 1.2 cm, one false return in 10,000. Chosen: flying points, losses, latency and mounting.
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


def _leg_odometry() -> ErrorPreset:
    """Return the drift of leg-inertial odometry, without camera or lidar.

    Sun et al. 2026 (arXiv 2602.17393) report the position error of quadrupeds after closed loops: on flat ground from
    0.16 m after 200 m to 7.7 m after 700 m, and 2.2 m after 120 m with a Unitree Go2; in vertical loops 0.22 m after
    15 m and 0.54 m after 20 m. Read as a random walk, an error of d after a distance D is a rate of d / sqrt(D), which
    two axes share on flat ground. As z drifts less on flat ground than in a climb, its lower limit is chosen. Also
    chosen: the limits of the yaw, and the noise.
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
    "perfect": _perfect,
    "miki_2022": _miki_2022,
    "ame_2": _ame_2,
    "depth_camera": _depth_camera,
    "spinning_lidar": _spinning_lidar,
    "leg_odometry": _leg_odometry,
}


def preset(name: str) -> ErrorPreset:
    """Return the errors of a preset.

    ```python
    sensor_errors = SensorErrors(preset("depth_camera").sensor, num_envs)
    pose_errors = PoseErrors(preset("leg_odometry").pose, num_envs)
    ```

    Args:
        name: One of perfect, miki_2022, ame_2, depth_camera, spinning_lidar, leg_odometry.

    Raises:
        ValueError: There is no preset of this name.
    """
    require(name in PRESETS, "name", f"must be one of {', '.join(PRESETS)}", repr(name), "use one of them")
    return PRESETS[name]()
