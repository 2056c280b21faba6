"""Poses of a lidar from its clouds alone, where a recording has none. Needs ``torchelev[odometry]``.

`track` finds the poses, `health` and `observability` stop it where it is lost, `gravity` finds the map's z axis, and
`tum` writes poses. Reading clouds out of recordings is the work of `io.bags`.
"""

from torchelev.io.odometry.gravity import GRAVITY, align, up_from_ground, up_from_imu
from torchelev.io.odometry.health import OdometryError
from torchelev.io.odometry.track import Sweep, Track, estimate_track
from torchelev.io.odometry.tum import write_tum

__all__ = [
    "GRAVITY",
    "OdometryError",
    "Sweep",
    "Track",
    "align",
    "estimate_track",
    "up_from_ground",
    "up_from_imu",
    "write_tum",
]
