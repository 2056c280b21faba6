"""Classify frames by their names, where motion alone does not decide."""

from __future__ import annotations

import re

_BASES = {"base_link", "base_footprint", "base", "trunk", "body", "pelvis", "chassis", "chassis_link", "vehicle"}
_WORLD = {
    "odom", "odometry", "map", "world", "earth", "global", "init", "initial", "origin", "utm", "enu", "ned", "local",
    "fixed",
}  # fmt: skip
_ROBOT = {
    "base", "footprint", "stabilized", "stabilised", "chassis", "body", "trunk", "torso", "pelvis", "waist", "mast",
    "head", "neck", "imu", "lidar", "laser", "velodyne", "ouster", "os", "livox", "rslidar", "hesai", "camera",
    "sensor", "ptu", "pan", "tilt", "gimbal", "wheel", "arm", "leg", "hip", "thigh", "calf", "foot", "vehicle",
    "robot", "link",
}  # fmt: skip


def is_base(frame: str) -> bool:
    """Return whether a frame has the name of a robot's base: base_link, robot1/base_footprint, trunk, ..."""
    name = frame.rsplit("/", 1)[-1].lower()
    return name in _BASES or name.endswith(("_base_link", "_base_footprint"))


def is_world(frame: str) -> bool:
    """Return whether a frame has the name of a fixed frame: odom, map, robot1/odom_lidar, camera_init, ..."""
    return frame == "vision" or bool(_WORLD & _words(frame))


def is_robot(frame: str) -> bool:
    """Return whether a frame has the name of a part of a robot, and not of a fixed frame."""
    return not is_world(frame) and bool(_ROBOT & _words(frame))


def _words(frame: str) -> set[str]:
    return set(re.split(r"[^a-z]+", frame.rsplit("/", 1)[-1].lower()))
