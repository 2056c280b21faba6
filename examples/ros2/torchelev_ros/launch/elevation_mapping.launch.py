"""Start torchelev's elevation mapping node, and RViz if wanted.

`ros2 launch torchelev_ros elevation_mapping.launch.py config:=robot.yaml`, or with the path of this file in place of
package and name, where the package is not built. `--show-args` lists the arguments.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = Path(__file__).resolve().parents[1]  # of the sources, or share/torchelev_ros
RESPAWN_DELAY = 2.0  # [s]
LEVELS = ("debug", "info", "warn", "error", "fatal")
# Name, default, meaning, choices.
ARGUMENTS: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    ("config", str(PACKAGE / "config" / "robot.yaml"), "YAML file with the parameters of the node and of the map", ()),
    ("namespace", "", "namespace of the node and of RViz, for example the name of the robot", ()),
    ("use_sim_time", "false", "use the time of /clock: for simulations and bags", ("true", "false")),
    ("rviz", "false", "start RViz with the displays of this package", ("true", "false")),
    ("log_level", "info", "lowest level of messages that the node logs", LEVELS),
    ("respawn", "true", "start the node again when it exits; with load_on_start it reads its map", ("true", "false")),
    ("torchelev", "", "path of the command torchelev; empty: that of the active environment or of the system", ()),
)


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, the node and RViz."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=meaning, choices=list(choices) or None)
        for name, default, meaning, choices in ARGUMENTS
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_node), make_rviz()])


def torchelev_command(path: str) -> list[str]:
    """Return the command line that starts torchelev.

    A virtual environment that is active comes first in PATH. `ros2 launch` itself runs in the system's Python, which
    may have torchelev as well.

    Args:
        path: of the command; empty: look for it.

    Raises:
        RuntimeError: torchelev is not installed.
    """
    command = shutil.which(os.path.expanduser(path) if path else "torchelev")
    if command:
        return [command]
    if not path and importlib.util.find_spec("torchelev"):
        return [sys.executable, "-m", "torchelev"]
    where = f"torchelev: expected a command, got '{path}'" if path else "torchelev: not found in PATH"
    raise RuntimeError(f"{where}; activate its virtual environment, or add torchelev:=~/torchelev/bin/torchelev")


def make_node(context: LaunchContext) -> list[Node]:
    """Return the node with the arguments of this launch.

    Raises:
        RuntimeError: there is no config file, or torchelev is not installed.
    """
    value = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    config = Path(value["config"]).expanduser().absolute()
    if not config.is_file():  # otherwise the node would be started again and again
        raise RuntimeError(f"config: expected a YAML file, got '{value['config']}'")
    program, *options = torchelev_command(value["torchelev"])
    node = Node(
        executable=program,
        arguments=[*options, "ros2", "--config", str(config)],
        name="elevation_mapping",
        namespace=value["namespace"],
        parameters=[{"use_sim_time": value["use_sim_time"] == "true"}],
        ros_arguments=["--log-level", value["log_level"]],
        output="screen",
        emulate_tty=True,
        respawn=value["respawn"] == "true",
        respawn_delay=RESPAWN_DELAY,
    )
    return [node]


def make_rviz() -> Node:
    """Return RViz in the namespace of the node, because its displays name topics relative to it."""
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        arguments=["-d", str(PACKAGE / "rviz" / "elevation_mapping.rviz")],
        parameters=[{"use_sim_time": LaunchConfiguration("use_sim_time")}],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
