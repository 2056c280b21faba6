"""The launch file of examples/ros2/torchelev_ros in real ROS 2: `make test-ros2`. Skipped where there is no rclpy."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("launch_ros.actions")  # needs lark
if "TORCHELEV_ROS2_FOLDER" not in os.environ:
    pytest.skip("run by make test-ros2", allow_module_level=True)

from rcl_interfaces.srv import GetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

PREPARED = Path(os.environ["TORCHELEV_ROS2_FOLDER"])
FILE = Path(__file__).resolve().parents[3] / "examples/ros2/torchelev_ros/launch/elevation_mapping.launch.py"
NODE = "/launched/elevation_mapping"
# What `ros2 launch` does, which the wheel lacks.
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

file, *arguments = sys.argv[1:]
pairs = [argument.split(":=", 1) for argument in arguments]
service = LaunchService()
included = IncludeLaunchDescription(PythonLaunchDescriptionSource(file), launch_arguments=pairs)
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""


class Launch:
    """A launch in a process of its own, and a node that asks the launched one."""

    def __init__(self, folder, *arguments):
        self._log = folder / "log"
        environment = os.environ | {"ROS_LOG_DIR": str(folder), "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, "-c", LAUNCH, str(FILE), *arguments]
        with open(self._log, "w") as file:
            self.process = subprocess.Popen(command, stdout=file, stderr=file, cwd=folder, env=environment)
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("watcher", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    @property
    def text(self):
        return self._log.read_text()

    @property
    def pids(self):
        """Processes of the node, the newest last."""
        return [int(pid) for pid in re.findall(r"process started with pid \[(\d+)\]", self.text)]

    def wait(self, holds, seconds=20.0):
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end and self.process.poll() is None, self.text
            time.sleep(0.05)

    def call(self, kind, name, request):
        """Call a service; repeat it while the service of a node that died is still remembered."""
        client, end = self._node.create_client(kind, f"{NODE}/{name}"), time.monotonic() + 20.0
        while True:
            assert time.monotonic() < end, self.text
            if client.wait_for_service(0.5):
                future = client.call_async(request)
                self._executor.spin_until_future_complete(future, 1.0)
                if future.done():
                    return future.result()

    def stop(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        self.process.wait(15)
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture
def torchelev(tmp_path):
    """The command of a virtual environment."""
    command = tmp_path / "torchelev"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m torchelev "$@"\n')
    command.chmod(0o755)
    return f"torchelev:={command}"


def test_a_node_in_its_namespace_that_comes_back_when_it_is_killed(tmp_path, torchelev):
    config, saved = tmp_path / "robot.yaml", tmp_path / "map.safetensors"
    library = (PREPARED / "library").read_text()
    more = {"library": library, "engine": "library", "map_file": saved, "load_on_start": "true"}
    lines = [f"{name}: {value}\n" for name, value in more.items()]
    config.write_text("".join(["map: {grid: {resolution: 0.1, length_x: 8.0, length_y: 8.0}}\n", *lines]))
    launch = Launch(tmp_path, f"config:={config}", "namespace:=launched", "use_sim_time:=true", torchelev)
    try:
        assert launch.call(Trigger, "clear_map", Trigger.Request()).success
        asked = GetParameters.Request(names=["use_sim_time", "map_file"])
        is_simulated, map_file = launch.call(GetParameters, "get_parameters", asked).values
        assert is_simulated.bool_value and map_file.string_value == str(saved)
        assert launch.call(Trigger, "save_map", Trigger.Request()).success
        os.kill(launch.pids[-1], signal.SIGKILL)
        launch.wait(lambda: len(launch.pids) == 2)
        assert launch.call(Trigger, "clear_map", Trigger.Request()).success
        assert f"loaded {saved}" in launch.text
    finally:
        launch.stop()
    assert len(launch.pids) == 2, "a launch that is stopped starts no node"


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["config:=/nowhere.yaml"], "config: expected a YAML file, got '/nowhere.yaml'"),
        (["torchelev:=/nowhere/torchelev"], "torchelev: expected a command, got '/nowhere/torchelev'"),
        (["log_level:=loud"], "log_level"),
    ],
)
def test_wrong_arguments_end_the_launch(tmp_path, arguments, words):
    launch = Launch(tmp_path, *arguments)
    try:
        assert launch.process.wait(15) != 0 and words in launch.text
        assert not launch.pids
    finally:
        launch.stop()
