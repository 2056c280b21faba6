"""`torchelev ros2`: the map as a ROS 2 node. Imports no PyTorch, which a robot may lack."""

from __future__ import annotations

from pathlib import Path

import click

from torchelev.app.user_error import user_errors

_HELP = """Run the map as a ROS 2 node: clouds and tf in, costmap, GridMap and height scans out.

Needs a ROS 2 of this Python (source its setup.bash first). Without PyTorch the
node keeps its map by the C library.

\b
  torchelev ros2 --config robot.yaml
  torchelev ros2 --config robot.yaml --ros-args -r points:=/lidar/points
  torchelev ros2 --ros-args -p base_frame:=trunk -p rate_costmap:=5.0

\b
robot.yaml:
  map_frame: odom
  base_frame: base_link
  clouds: [/lidar/points]
  map:
    grid: {resolution: 0.05, length_x: 8.0, length_y: 8.0}

What follows --ros-args is for ROS: remappings, namespaces, parameters.
"""


@click.command(
    "ros2",
    help=_HELP,
    short_help="Run the map as a ROS 2 node.",
    context_settings={"ignore_unknown_options": True, "help_option_names": ["-h", "--help"]},
)
@click.option(
    "--config",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="YAML with the node's parameters, and the map's settings below `map`.  [default: all defaults]",
)
@click.argument("ros_arguments", nargs=-1, type=click.UNPROCESSED, metavar="[--ros-args ...]")
def ros2_command(config: Path | None, ros_arguments: tuple[str, ...]) -> None:
    """Run `torchelev ros2`."""
    if ros_arguments and ros_arguments[0] != "--ros-args":
        raise click.UsageError(f"no such option or argument: {ros_arguments[0]}; what is for ROS follows --ros-args")
    with user_errors():
        from torchelev.ros2.settings import NodeSettings, read_node_file

        settings, cfg = (NodeSettings(), {}) if config is None else read_node_file(config)
        try:
            import rclpy  # noqa: F401
        except ImportError as error:
            hint = "source the setup.bash of a ROS 2 whose Python is this one"
            raise click.ClickException(f"rclpy cannot be imported ({error}); {hint}") from error
        from torchelev.ros2.node import spin

        spin(settings, cfg, ["torchelev", *ros_arguments])
