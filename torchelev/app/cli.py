"""The command line: commands, options and help texts. Each command's work is done in a module of its own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from torchelev import __version__
from torchelev.app.map_command import run_map
from torchelev.app.map_request import MapRequest
from torchelev.app.user_error import user_errors

_MAP_HELP = """Build an elevation map from RECORDING, a folder of scans with poses, or a bag.

A bag is a file .bag (ROS 1), .mcap or .db3 (ROS 2), or a ROS 2 folder. Its
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
  .png (uint16, in millimetres or as depth_scale in the intrinsics says;
  camera frame: x right, y down, z forward)

The pose file has one line per scan: the sensor's pose in a map frame whose
z axis points up. A line holds 12 numbers (KITTI: the upper 3x4 of the pose
matrix, row by row) or 8 numbers (TUM: t x y z qx qy qz qw). The poses of the
KITTI odometry benchmark describe the camera, whose z axis points forward;
convert them with its calibration first.

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


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__)
def main() -> None:
    """Build elevation maps from point clouds and depth images."""


@main.command("map", help=_MAP_HELP, short_help="Build an elevation map from scans with poses, or a bag.")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "--poses",
    type=click.Path(path_type=Path),
    help="Pose file.  [default: poses.txt or groundtruth.txt in or beside RECORDING] Of a bag: a topic of Odometry or "
    "PoseStamped in place of its transforms.",
)
@click.option(
    "--intrinsics",
    type=click.Path(path_type=Path),
    help="Camera intrinsics for depth images: text or YAML with fx, fy, cx, cy.",
)
@click.option(
    "--out",
    default="map",
    show_default=True,
    metavar="PREFIX",
    help="Prefix of the output files, or a folder for them.",
)
@click.option("--resolution", type=float, metavar="M", help="Cell size [m].  [default: from --config, or 0.1]")
@click.option(
    "--size", type=float, metavar="M", help="Side length of the square map [m].  [default: from --config, or 20]"
)
@click.option(
    "--fixed",
    is_flag=True,
    help="Keep the map in place, centred on the sensor's path, instead of following the sensor.",
)
@click.option("--device", default="cpu", show_default=True, help="Torch device: cpu, cuda, cuda:1, ...")
@click.option(
    "--config", type=click.Path(path_type=Path), help="YAML file with settings of ElevationMapConfig, grouped by stage."
)
@click.option(
    "--dt", type=float, metavar="S", help="Time between scans [s].  [default: from the pose file's timestamps, or 0.1]"
)
@click.option(
    "--sensor-height",
    type=float,
    metavar="M",
    help="Height of the sensor above the robot's base [m]; turns overlap clearance on.",
)
@click.option(
    "--extrinsics",
    metavar="FILE|NUMBERS",
    help="T_base_sensor, the sensor's pose on the robot: a file, or 12 numbers (3x4) in quotes; "
    "turns overlap clearance on.",
)
@click.option(
    "--poses-of",
    type=click.Choice(["sensor", "base"]),
    default="sensor",
    show_default=True,
    help="Frame whose poses the pose file holds; 'base' requires --extrinsics.",
)
@click.option(
    "--bin-layout", metavar="LAYOUT", help="Layout of .bin files: float32x5, float64x4, ...  [default: float32x4]"
)
@click.option(
    "--quaternions",
    type=click.Choice(["xyzw", "wxyz"]),
    help="Order of quaternions in a TUM pose file.  [default: xyzw]",
)
@click.option(
    "--time-unit",
    type=click.Choice(["s", "ms", "us", "ns"]),
    help="Unit of timestamps in a TUM pose file.  [default: s, or detected if since 1970]",
)
@click.option(
    "--pcd-frame",
    type=click.Choice(["sensor", "viewpoint"]),
    help="Frame of the points in .pcd files: the sensor frame, or the frame in which VIEWPOINT is given.",
)
@click.option("--points", multiple=True, metavar="TOPIC", help="Bag: clouds or laser scans; may be repeated.")
@click.option("--depth", multiple=True, metavar="TOPIC", help="Bag: depth images with a CameraInfo; may be repeated.")
@click.option("--map-frame", metavar="FRAME", help="Bag: frame in which the map is built, such as odom.")
@click.option("--base-frame", metavar="FRAME", help="Bag: frame that the map follows, such as base_link.")
@click.option(
    "--grid-map",
    type=click.Path(path_type=Path),
    metavar="BAG",
    help="Also write the growing map to this bag as GridMap, for RViz or Foxglove: .mcap, .db3 or .bag.",
)
@click.option(
    "--video",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Also film the growing map: .mp4 or .gif, ten frames a second.",
)
@click.option(
    "--every",
    type=float,
    metavar="S",
    help="Time of the recording between two maps or frames [s]; 0: each scan.  [default: 1 for --grid-map; for --video "
    "so many scans that it lasts a minute at most]",
)
def map_command(**options: Any) -> None:
    """Run `torchelev map`; its help text is `_MAP_HELP`."""
    sys.exit(run_map(MapRequest(**options)))


@main.command("bag", short_help="List what a bag holds, and how to map it.")
@click.argument("bag", type=click.Path(path_type=Path))
def bag_command(bag: Path) -> None:
    """List topics, types, counts, rates and frames of BAG and its tree of transforms; propose the command to map it."""
    from torchelev.app.bag_command import describe_bag

    with user_errors():
        click.echo(describe_bag(bag))


@main.command("demo", short_help="Map a simulated walk and compare it with ground truth.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("demo.png"), show_default=True, help="Picture to write."
)
@click.option("--seconds", type=float, metavar="S", help="Simulated time to walk [s].  [default: the whole course]")
@click.option("--quiet", is_flag=True, help="Hide the progress bar.")
def demo_command(out: Path, seconds: float | None, quiet: bool) -> None:
    """Map a simulated walk with a depth camera and compare the map with the ground truth."""
    from torchelev.app.demo import run_demo

    click.echo(run_demo(out=out, seconds=seconds, progress=not quiet))
    click.echo(f"wrote {out}")


_FLEET_HELP = """Let simulated robots explore a terrain together; merge what they see into one map.

All robots share one batched ElevationMap. Each of them walks to the frontiers
of what is known, around what is too steep, and has its own error of height,
up to 15 cm, which also drifts. Once a second their maps become part of a site
map, which finds these offsets from the ground that they have in common.

\b
  torchelev fleet                                 16 robots, 60 x 60 m
  torchelev fleet --robots 4 --size 30 --seed 7
  torchelev fleet --site hill/                    keep the map, go on later
  torchelev fleet --live                          watch it grow in the browser

The mission ends when nothing is left to explore, or after --seconds. Ctrl-C
ends it earlier and keeps what was mapped.

\b
Output files:
  fleet.png   ground truth, site map, its error, and the robots' paths
  fleet.json  the numbers, with those of each robot and of each merge
"""


@main.command("fleet", help=_FLEET_HELP, short_help="Map a simulated site with many robots at once.")
@click.option("--robots", type=int, default=16, show_default=True, metavar="N", help="Number of robots.")
@click.option("--size", type=float, default=60.0, show_default=True, metavar="M", help="Side of the square area [m].")
@click.option("--resolution", type=float, default=0.1, show_default=True, metavar="M", help="Cell size [m].")
@click.option(
    "--seconds", type=float, default=120.0, show_default=True, metavar="S", help="Simulated time at most [s]."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the terrain and of all errors.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("fleet.png"),
    show_default=True,
    help="Picture to write; the numbers lie beside it as .json.",
)
@click.option(
    "--site",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Keep the site map there. One that is there is continued: give the same --seed, --size and --resolution. "
    "Needs torchelev[site].  [default: a temporary folder]",
)
@click.option("--live", is_flag=True, help="Show the growing map in the browser; needs torchelev[view].")
@click.option("--host", default="127.0.0.1", show_default=True, help="Of --live; 0.0.0.0: let other machines connect.")
@click.option("--port", type=click.IntRange(1, 65535), default=8080, show_default=True, help="Of --live.")
@click.option("--quiet", is_flag=True, help="Hide the progress bar.")
def fleet_command(quiet: bool, **options: Any) -> None:
    """Run `torchelev fleet`; its help text is `_FLEET_HELP`."""
    from torchelev.app.fleet.command import run_fleet
    from torchelev.app.fleet.request import FleetRequest

    with user_errors():
        request = FleetRequest(**options)
    sys.exit(run_fleet(request, quiet))


_VIEW_HELP = """Show a map in the browser while it grows.

RECORDING is a folder of scans or a bag, as of `torchelev map`, with the same
options; or a map that was saved, .npz. Without it, a simulated walk is shown.

\b
  torchelev view                   the demo's walk
  torchelev view drive.mcap        a bag
  torchelev view drive/            a folder of scans with poses
  torchelev view map.npz           a saved map

The page plays the recording, pauses, steps and goes back. It colours the
surface by any layer, shows cloud, frames, path and planes, and says the values
of the cell that is clicked. Ctrl-C closes it.
"""


def _view_command(recording: Path | None, host: str, port: int, paused: bool, **options: Any) -> None:
    """Run `torchelev view`; its help text is `_VIEW_HELP`."""
    from torchelev.app.view_command import run_view

    request = None if recording is None else MapRequest(recording=recording, **options)
    run_view(request, host, port, paused)


_OUTPUTS = ("recording", "out", "grid_map", "video", "every")  # parameters of `map` that `view` lacks
_VIEW_OPTIONS: list[click.Parameter] = [
    click.Argument(["recording"], type=click.Path(path_type=Path), required=False),
    click.Option(["--host"], default="127.0.0.1", show_default=True, help="0.0.0.0: let other machines connect."),
    click.Option(["--port"], type=click.IntRange(1, 65535), default=8080, show_default=True, help="Of the page."),
    click.Option(["--paused"], is_flag=True, help="Wait at the first scan."),
    *(parameter for parameter in map_command.params if parameter.name not in _OUTPUTS),
]
main.add_command(
    click.Command(
        "view", params=_VIEW_OPTIONS, callback=_view_command, help=_VIEW_HELP, short_help="Show a map in the browser."
    )
)


@main.command("filters", short_help="List the filters that a config can use.")
def filters_command() -> None:
    """List the filters that a config can use, with their inputs and settings."""
    from torchelev.filters.registry import listing

    click.echo(listing())
