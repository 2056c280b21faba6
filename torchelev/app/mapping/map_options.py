"""The options and the help text of `torchelev map`, which `torchelev view` shares."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

MAP_HELP = """Build an elevation map from RECORDING, a folder of scans with poses, or a bag.

A bag is a file .bag (ROS 1), .mcap or .db3 (ROS 2), or a folder of them. Its
topics and frames are found where there is no doubt; `torchelev bag` lists them.

\b
  torchelev map drive.mcap
  torchelev map drive.mcap --points /lidar/points \\
      --map-frame odom --base-frame base_link

A folder, or its subfolder scans/, holds one file per scan. File names set the
order; numbers in them count by value, so 2 comes before 10. Maps written there
earlier are ignored.

\b
Point clouds, in metres, in the sensor frame:
  .bin (KITTI: float32 x y z intensity)  .npy  .npz  .ply  .pcd
Depth images, with --intrinsics:
  .png (uint16, in millimetres or as depth_scale in the intrinsics says),
  .npy or .npz (floats in metres, or uint16); camera frame: x right, y down,
  z forward

Times of points (a field t, time, timestamp ... or a column of seconds) take
the motion within a scan out of it, if the poses have times or --dt is given.

The pose file has one line per scan: the sensor's pose in a map frame whose
z axis points up. A line holds 12 numbers (KITTI: the upper 3x4 of the pose
matrix, row by row) or 8 numbers (TUM: t x y z qx qy qz qw), with an index
before them or without. The poses of the KITTI odometry benchmark describe the
camera, whose z axis points forward: put its calib.txt beside the poses or the
scans, and they become the lidar's.

\b
Example: a folder drive/ with scans/000000.bin, ... and poses.txt
  torchelev map drive
  torchelev map drive/scans --poses drive/poses.txt \\
      --resolution 0.05 --size 30 --device cuda --out maps/drive

Some formats leave their layout open: use --bin-layout, --quaternions,
--time-unit and --pcd-frame to specify it. Files that contradict the layout in
use are rejected.

\b
Output files:
  PREFIX.npz  every layer with its geometry, for NumPy
  PREFIX.png  a picture of the main layers
  PREFIX.ply  a mesh for MeshLab, CloudCompare or Blender

The map is a window that follows the sensor and forgets what leaves it. To keep
the whole area, use --fixed with a larger --size.

\b
All other settings go into a YAML file, grouped by stage; see --config:
  sensor: {min_distance: 0.8}    # [m] ignore returns from the robot itself
  drift: null                    # turn height-drift compensation off
"""

_OPTIONS: list[Callable[[Any], Any]] = [
    click.argument("recording", type=click.Path(path_type=Path)),
    click.option(
        "--poses",
        type=click.Path(path_type=Path),
        help="Pose file.  [default: poses.txt or groundtruth.txt in or beside RECORDING] Of a bag: a topic of Odometry "
        "or PoseStamped in place of its transforms.",
    ),
    click.option(
        "--intrinsics",
        type=click.Path(path_type=Path),
        help="Camera intrinsics for depth images: text or YAML with fx, fy, cx, cy.",
    ),
    click.option(
        "--out",
        default="map",
        show_default=True,
        metavar="PREFIX",
        help="Prefix of the output files, or a folder for them.",
    ),
    click.option("--resolution", type=float, metavar="M", help="Cell size [m].  [default: from --config, or 0.1]"),
    click.option(
        "--size", type=float, metavar="M", help="Side length of the square map [m].  [default: from --config, or 20]"
    ),
    click.option(
        "--fixed",
        is_flag=True,
        help="Keep the map in place, centred on the sensor's path, instead of following the sensor.",
    ),
    click.option("--device", default="cpu", show_default=True, help="Torch device: cpu, cuda, cuda:1, ..."),
    click.option(
        "--config",
        type=click.Path(path_type=Path),
        help="YAML file with settings of ElevationMapConfig, grouped by stage.",
    ),
    click.option(
        "--dt",
        type=float,
        metavar="S",
        help="Time between scans [s].  [default: from the pose file's timestamps, or 0.1]",
    ),
    click.option(
        "--sensor-height",
        type=float,
        metavar="M",
        help="Height of the sensor above the robot's base [m]; turns overlap clearance on.",
    ),
    click.option(
        "--extrinsics",
        metavar="FILE|NUMBERS",
        help="T_base_sensor, the sensor's pose on the robot: a file, or 12 numbers (3x4) in quotes; "
        "turns overlap clearance on. Of a bag: where its transforms do not say it, or in their place.",
    ),
    click.option(
        "--poses-of",
        type=click.Choice(["sensor", "base"]),
        default="sensor",
        show_default=True,
        help="Frame whose poses the pose file holds; 'base' requires --extrinsics.",
    ),
    click.option(
        "--bin-layout", metavar="LAYOUT", help="Layout of .bin files: float32x5, float64x4, ...  [default: float32x4]"
    ),
    click.option(
        "--quaternions",
        type=click.Choice(["xyzw", "wxyz"]),
        help="Order of quaternions in a TUM pose file.  [default: xyzw]",
    ),
    click.option(
        "--time-unit",
        type=click.Choice(["s", "ms", "us", "ns"]),
        help="Unit of timestamps in a TUM pose file.  [default: s, or detected if since 1970]",
    ),
    click.option(
        "--pcd-frame",
        type=click.Choice(["sensor", "viewpoint"]),
        help="Frame of the points in .pcd files: the sensor frame, or the frame in which VIEWPOINT is given.",
    ),
    click.option("--points", multiple=True, metavar="TOPIC", help="Bag: clouds or laser scans; may be repeated."),
    click.option(
        "--depth", multiple=True, metavar="TOPIC", help="Bag: depth images with a CameraInfo; may be repeated."
    ),
    click.option(
        "--camera-info",
        multiple=True,
        metavar="TOPIC",
        help="Bag: CameraInfo of the depth images, once or for each --depth.  [default: the one beside them]",
    ),
    click.option(
        "--depth-scale",
        type=float,
        metavar="M",
        help="Bag: metres per unit of depth.  [default: what librealsense recorded, or 0.001 of integers, 1 of floats]",
    ),
    click.option(
        "--depth-axes",
        type=click.Choice(["optical", "forward", "opengl"]),
        help="Bag: axes of the depth images' frame: optical (z forward, y down), forward (x forward, z up), as "
        "simulators stamp them, or opengl (z backward, y up).  [default: optical]",
    ),
    click.option("--map-frame", metavar="FRAME", help="Bag: frame in which the map is built, such as odom."),
    click.option("--base-frame", metavar="FRAME", help="Bag: frame that the map follows, such as base_link."),
    click.option(
        "--tf",
        multiple=True,
        metavar="TOPIC",
        help="Bag: transforms, such as /robot1/tf; may be repeated.  [default: /tf and /tf_static, or those of the "
        "scans' namespace]",
    ),
    click.option(
        "--rays-from",
        metavar="FRAME",
        help="Bag: the sensor's frame, where rays start, of clouds that are in the map's frame already.  [default: the "
        "base]",
    ),
    click.option(
        "--clock-offset",
        multiple=True,
        metavar="[TOPIC=]S",
        help="Bag: add this to the stamps of the scans [s], of one topic or all; may be repeated.",
    ),
    click.option(
        "--stamps",
        type=click.Choice(["header", "recorded"]),
        default="header",
        show_default=True,
        help="Bag: times of scans and poses: their stamps, or when they were recorded.",
    ),
    click.option(
        "--start", type=float, metavar="S", help="Bag: leave out what was recorded before [s from its start]."
    ),
    click.option("--end", type=float, metavar="S", help="Bag: leave out what was recorded after [s from its start]."),
    click.option(
        "--odometry",
        type=click.Choice(["kiss-icp"]),
        help="Bag without poses: find them from the clouds of the (first) --points; needs torchelev[odometry].",
    ),
    click.option(
        "--imu",
        metavar="TOPIC",
        help="With --odometry: Imu by whose gravity the map's z axis points up.  [default: the normal of the ground "
        "around the start]",
    ),
    click.option(
        "--save-poses",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="With --odometry: write the lidar's pose at each scan's stamp to this TUM file.",
    ),
    click.option(
        "--grid-map",
        type=click.Path(path_type=Path),
        metavar="BAG",
        help="Also write the growing map to this bag as GridMap, for RViz or Foxglove: .mcap, .db3 or .bag.",
    ),
    click.option(
        "--video",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Also film the growing map: .mp4 or .gif, ten frames a second.",
    ),
    click.option(
        "--every",
        type=float,
        metavar="S",
        help="Time of the recording between two maps or frames [s]; 0: each scan.  [default: 1 for --grid-map; for "
        "--video so many scans that it lasts a minute at most]",
    ),
]


def map_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the argument and the options of `torchelev map`, in the order in which they stand here."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
