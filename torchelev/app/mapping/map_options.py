"""The options of `torchelev map`, which `torchelev view` shares."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from torchelev.app.option_groups import option_of

_recording, _folder, _bag = option_of("Recording"), option_of("Folders of files"), option_of("Bags")
_map, _output = option_of("Map"), option_of("Output")
_PATH = click.Path(path_type=Path)

_OPTIONS: list[Callable[[Any], Any]] = [
    click.argument("recording", type=_PATH),
    _recording(
        "--poses",
        type=_PATH,
        metavar="FILE|TOPIC",
        help="Pose file of a folder.  [default: poses.txt or groundtruth.txt in or beside RECORDING]  For a bag: topic "
        "of Odometry or PoseStamped to use instead of its transforms.",
    ),
    _recording(
        "--extrinsics",
        metavar="FILE|NUMBERS",
        help="T_base_sensor, the sensor's pose on the robot: a file, or 12 numbers (3x4) in quotes; turns overlap "
        "clearance on. Replaces what the transforms of a bag say.",
    ),
    _recording(
        "--depth-scale",
        type=float,
        metavar="M",
        help="Metres per unit of depth.  [default: from the intrinsics file or as librealsense recorded it, or 0.001 "
        "for integers and 1 for floats]",
    ),
    _recording(
        "--depth-axes",
        type=click.Choice(["optical", "forward", "opengl"]),
        help="Axes of the frame of depth images: optical (z forward, y down), forward (x forward, z up; simulators) or "
        "opengl (z backward, y up).  [default: optical]",
    ),
    _recording(
        "--colour",
        "--color",
        "colour",
        is_flag=True,
        help="Fuse the colours of the points into the channel rgb: fields rgb, rgba, or red, green, blue of clouds in "
        "bags, .pcd and .ply files.",
    ),
    _folder("--intrinsics", type=_PATH, metavar="FILE", help="Camera of depth images: text or YAML, fx, fy, cx, cy."),
    _folder(
        "--dt",
        type=float,
        metavar="S",
        help="Time between scans [s].  [default: from the pose file's timestamps, or 0.1]",
    ),
    _folder(
        "--poses-of",
        type=click.Choice(["sensor", "base"]),
        default="sensor",
        show_default=True,
        help="Frame whose poses the pose file holds; 'base' requires --extrinsics.",
    ),
    _folder(
        "--sensor-height",
        type=float,
        metavar="M",
        help="Height of the sensor above the robot's base [m]; turns overlap clearance on.",
    ),
    _folder(
        "--bin-layout", metavar="LAYOUT", help="Layout of .bin files: float32x5, float64x4, ...  [default: float32x4]"
    ),
    _folder(
        "--quaternions",
        type=click.Choice(["xyzw", "wxyz"]),
        help="Order of quaternions in a TUM pose file.  [default: xyzw]",
    ),
    _folder(
        "--time-unit",
        type=click.Choice(["s", "ms", "us", "ns"]),
        help="Unit of timestamps in a TUM pose file.  [default: s, or detected if since 1970]",
    ),
    _folder(
        "--pcd-frame",
        type=click.Choice(["sensor", "viewpoint"]),
        help="Frame of the points in .pcd files: the sensor frame, or the frame in which VIEWPOINT is given.",
    ),
    _bag("--points", multiple=True, metavar="TOPIC", help="Clouds or laser scans; may be repeated."),
    _bag("--depth", multiple=True, metavar="TOPIC", help="Depth images; may be repeated."),
    _bag(
        "--camera-info",
        multiple=True,
        metavar="TOPIC",
        help="CameraInfo of the depth images, once or for each --depth.  [default: the one beside them]",
    ),
    _bag(
        "--semantic",
        metavar="TOPIC",
        help="Images of class labels, mono8 or 16UC1, which are painted into the channel semantic; the largest number "
        "of the type is no class.",
    ),
    _bag("--semantic-info", metavar="TOPIC", help="CameraInfo of --semantic.  [default: the one beside it]"),
    _bag(
        "--classes",
        metavar="NAMES",
        help="Names of the labels 0, 1, ... of --semantic, such as grass,stone,mud.  [default: numbers, as many as "
        "there are]",
    ),
    _bag("--map-frame", metavar="FRAME", help="Frame in which the map is built, such as odom."),
    _bag("--base-frame", metavar="FRAME", help="Frame that the map follows, such as base_link."),
    _bag(
        "--tf",
        multiple=True,
        metavar="TOPIC",
        help="Transforms, such as /robot1/tf; may be repeated.  [default: /tf and /tf_static, or those of the scans' "
        "namespace]",
    ),
    _bag(
        "--rays-from",
        metavar="FRAME",
        help="Frame at which rays start if the clouds are already in the map frame.  [default: the base]",
    ),
    _bag(
        "--clock-offset",
        multiple=True,
        metavar="[TOPIC=]S",
        help="Seconds to add to the stamps of the scans, of one topic or of all; may be repeated.",
    ),
    _bag(
        "--stamps",
        type=click.Choice(["header", "recorded"]),
        default="header",
        show_default=True,
        help="Times of scans and poses: the stamps in their headers, or when they were recorded.",
    ),
    _bag("--start", type=float, metavar="S", help="Skip what was recorded earlier [s after the start of the bag]."),
    _bag("--end", type=float, metavar="S", help="Skip what was recorded later [s after the start of the bag]."),
    _bag(
        "--odometry",
        type=click.Choice(["kiss-icp"]),
        help="Without poses in the bag: find them from the clouds of the first --points; needs torchelev[odometry].",
    ),
    _bag(
        "--imu",
        metavar="TOPIC",
        help="With --odometry: Imu whose gravity gives the map's z axis.  [default: the normal of the ground around "
        "the start]",
    ),
    _bag(
        "--save-poses",
        type=_PATH,
        metavar="FILE",
        help="With --odometry: write the lidar's pose at each scan's stamp to this TUM file.",
    ),
    _map("--resolution", type=float, metavar="M", help="Cell size [m].  [default: from --config, or 0.1]"),
    _map("--size", type=float, metavar="M", help="Side length of the square map [m].  [default: from --config, or 20]"),
    _map(
        "--fixed",
        is_flag=True,
        help="Keep the map in place, centred on the sensor's path, instead of following the sensor.",
    ),
    _map(
        "--levels",
        type=int,
        metavar="K",
        help="Surfaces in each cell, such as 3 for ground, table and ceiling: the ground is the one that the robot "
        "reaches.  [default: from --config, or the ground alone]",
    ),
    _map("--device", default="cpu", show_default=True, help="Torch device: cpu, cuda, cuda:1, ..."),
    _map("--config", type=_PATH, metavar="FILE", help="YAML settings of ElevationMapConfig, grouped by stage."),
    _output(
        "--out",
        default="map",
        show_default=True,
        metavar="PREFIX",
        help="Prefix of the output files, or a folder for them.",
    ),
    _output(
        "--grid-map",
        type=_PATH,
        metavar="BAG",
        help="Also write the growing map to this bag as GridMap, for RViz or Foxglove: .mcap, .db3 or .bag.",
    ),
    _output(
        "--video", type=_PATH, metavar="FILE", help="Also film the growing map: .mp4 or .gif, ten frames a second."
    ),
    _output(
        "--every",
        type=float,
        metavar="S",
        help="Time of the recording between two maps or frames [s]; 0: each scan.  [default: 1 for --grid-map; for "
        "--video, as many as a video of one minute needs]",
    ),
]


def map_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the argument and the options of `torchelev map`, in the order in which they stand here."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
