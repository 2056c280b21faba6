"""The map's frame is the one in which the robot travels, whatever its tree of transforms."""

from pathlib import Path

import numpy as np
import pytest

from tests.io.bags.poses.trees import (
    correct,
    drive,
    fixed,
    jittered,
    nod,
    place,
    spin,
    stay,
    sway,
    tree_of,
)
from torchelev.io import RecordingError
from torchelev.io.bags import BagRequest
from torchelev.io.bags.poses.frames import choose_frames
from torchelev.io.bags.poses.rows import invert


def back(pose):
    return lambda t: invert(pose(t))


def choose(tree, sensor="lidar", **request):
    return choose_frames(Path("drive"), tree, sensor, BagRequest(**request))


LIDAR = [("base_link", "lidar")]
SOUND = {
    "plain": (tree_of({("odom", "base_link"): drive}, LIDAR), "odom", "base_link"),
    "walking footprint": (
        tree_of({("odom", "base_footprint"): drive, ("base_footprint", "base_link"): sway}, LIDAR),
        "odom", "base_link",
    ),
    "walking footprint, own names": (
        tree_of({("start", "ground"): drive, ("ground", "frame"): sway}, [("frame", "lidar")]), "start", "ground",
    ),
    "walking footprint with a name of its own": (
        tree_of({("start", "ground"): drive, ("ground", "base_link"): sway}, LIDAR), "start", "base_link",
    ),
    "mast": (
        tree_of(
            {("odom", "base_footprint"): drive, ("base_footprint", "base_stabilized"): sway,
             ("base_stabilized", "base_link"): sway, ("base_link", "mast"): nod, ("mast", "pan_tilt"): spin},
            [("pan_tilt", "lidar")],
        ),
        "odom", "base_link",
    ),
    "mast on an unnamed base": (
        tree_of({("odom", "chassis"): drive, ("chassis", "mast"): nod}, [("mast", "lidar")]), "odom", "chassis",
    ),
    "localisation that jumps": (
        tree_of({("map", "odom"): correct, ("odom", "base_link"): drive}, LIDAR), "odom", "base_link",
    ),
    "earth": (
        tree_of({("map", "odom"): correct, ("odom", "base_link"): drive}, [*LIDAR, ("earth", "map")]),
        "odom", "base_link",
    ),
    "localisation alone": (tree_of({("map", "base_link"): drive}, LIDAR), "map", "base_link"),
    "humanoid": (
        tree_of(
            {("odom", "pelvis"): drive, ("pelvis", "waist"): sway, ("waist", "torso"): sway, ("torso", "head"): nod},
            [("head", "lidar")],
        ),
        "odom", "pelvis",
    ),
    "spinning lidar": (tree_of({("odom", "base_link"): drive, ("base_link", "lidar"): spin}), "odom", "base_link"),
    "base below body": (tree_of({("odom", "body"): drive}, [("body", "base_link"), *LIDAR]), "odom", "body"),
    "mounting with noise": (
        tree_of({("odom", "vehicle"): drive, ("vehicle", "lidar"): jittered}), "odom", "vehicle",
    ),
    "unnamed base, mounting with noise": (
        tree_of({("odom", "platform"): drive, ("platform", "lidar"): jittered}), "odom", "platform",
    ),
    "base below a footprint with the odometry": (
        tree_of({("odom", "base_footprint"): stay, ("base_footprint", "base_link"): drive}, LIDAR), "odom", "base_link",
    ),
    "imu as base": (tree_of({("odom", "imu_link"): drive}, [("imu_link", "lidar")]), "odom", "imu_link"),
    "sensor's own poses": (tree_of({("odom", "lidar"): drive}), "odom", "lidar"),
    "robot beside another that drives farther": (
        tree_of({("world", "a/odom"): stay, ("a/odom", "a/base_link"): drive, ("world", "b/odom"): stay,
                 ("b/odom", "b/base_link"): lambda t: place(y=20 * t)}, [("a/base_link", "lidar")]),
        "a/odom", "a/base_link",
    ),
    "odometry upside down": (tree_of({("base_link", "odom_lidar"): back(drive)}, LIDAR), "odom_lidar", "base_link"),
    "odometry upside down, wheels and mast": (
        tree_of({("base_link", "odom_lidar"): back(drive), ("base_link", "wheel"): spin, ("base_link", "mast"): nod},
                [("mast", "lidar")]),
        "odom_lidar", "base_link",
    ),
    "turns in place": (tree_of({("odom", "base_link"): lambda t: place(yaw=t)}, LIDAR), "odom", "base_link"),
    "body above two odometries": (
        tree_of({("body", "odom"): back(drive), ("body", "vision"): back(drive)}, [("body", "lidar")]), "odom", "body",
    ),
    "odometry above and below": (
        tree_of({("odom", "body"): drive, ("body", "vision"): back(drive)}, [("body", "lidar")]), "odom", "body",
    ),
    "odometry below a body that moves": (
        tree_of({("base_link", "body"): sway, ("body", "odom"): back(drive)}, LIDAR), "odom", "base_link",
    ),
    "odometry below the lidar": (
        tree_of({("lidar", "odom"): back(drive), ("odom", "map"): correct}, LIDAR), "odom", "base_link",
    ),
    "arm": (
        tree_of({("base", "link1"): spin, ("link1", "link2"): nod}, [("world", "base"), ("link2", "lidar")]),
        "world", "link2",
    ),
    "mounting on /tf, base below an imu": (
        tree_of({("odom", "imu_link"): drive, ("imu_link", "base_link"): fixed}, LIDAR), "odom", "base_link",
    ),
    "clouds of odometry": (tree_of({("camera_init", "body"): drive}), "camera_init", "body"),
    "clouds of odometry, unnamed": (tree_of({("start", "imu"): drive}), "start", "imu"),
    "clouds of odometry, LOAM": (tree_of({("camera_init", "aft_mapped"): drive}), "camera_init", "aft_mapped"),
    "clouds in map": (
        tree_of({("map", "odom"): correct, ("odom", "base_link"): drive}, LIDAR), "map", "base_link",
    ),
    "clouds in odom": (
        tree_of({("map", "odom"): correct, ("odom", "base_link"): drive}, LIDAR), "odom", "base_link",
    ),
}  # fmt: skip
CLOUDS = {
    "clouds of odometry": "camera_init", "clouds of odometry, unnamed": "start", "clouds in map": "map",
    "clouds in odom": "odom", "clouds of odometry, LOAM": "camera_init",
}  # fmt: skip


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", SOUND)
def test_the_map_is_where_the_base_travels(name):
    tree, map_frame, base_frame = SOUND[name]
    assert choose(tree, CLOUDS.get(name, "lidar")) == (map_frame, base_frame, [])


@pytest.mark.parametrize("name", SOUND)
def test_the_frames_that_were_found_can_be_asked_for(name):
    """As the command that `torchelev bag` proposes does."""
    tree, map_frame, base_frame = SOUND[name]
    frames = choose(tree, CLOUDS.get(name, "lidar"), map_frame=map_frame, base_frame=base_frame)
    assert frames == (map_frame, base_frame, [])


def test_a_frame_of_the_robot_is_not_taken_for_the_map_without_a_word():
    tree = SOUND["walking footprint"][0]
    frames = choose(tree, map_frame="base_footprint")
    assert frames.map == "base_footprint" and "give --map-frame odom" in frames.notes[0]
    assert "base_link travels 0.04 m in base_footprint, and 5.0 m in odom" in frames.notes[0]


def test_two_frames_that_could_be_the_map_are_named():
    tree = tree_of({("a", "b"): drive, ("b", "c"): drive}, [("c", "lidar")])
    frames = choose(tree)
    assert frames.map in ("a", "b")
    assert "--map-frame b or --map-frame a" in frames.notes[0] or "--map-frame a or --map-frame b" in frames.notes[0]


def test_a_robot_that_stands_still_is_mapped_by_names_and_named():
    tree = tree_of({("map", "odom"): stay, ("odom", "base_link"): fixed, ("base_link", "lidar"): jittered})
    frames = choose(tree)
    assert frames[:2] == ("odom", "base_link")
    assert "base_link hardly moves in odom, by 0.00 m" in frames.notes[0]
    assert "if it stands still, give --map-frame odom --base-frame base_link" in frames.notes[0]
    assert choose(tree, map_frame="odom", base_frame="base_link") == ("odom", "base_link", [])


def test_a_mast_does_not_hide_that_nothing_drives():
    tree = tree_of({("base_link", "mast"): nod}, [("mast", "lidar")])
    (note,) = choose(tree).notes
    assert "base_link has the name of a robot's frame" in note and "give --poses TOPIC" in note


def test_what_moves_is_named_where_nothing_is_chosen():
    tree = tree_of({("base_link", "arm"): spin}, LIDAR)
    with pytest.raises(
        RecordingError, match="above it are base_link, and what moves is arm in base_link; give --poses"
    ):
        choose(tree)


def test_jitter_is_constant_and_sway_is_not():
    tree = tree_of({("a", "b"): jittered, ("a", "c"): sway, ("a", "d"): lambda t: place(yaw=np.pi * (1 + 1e-9 * t))})
    assert tree.is_constant("b") and tree.is_constant("d") and not tree.is_constant("c")
