"""A robot for the tests in real ROS 2, which `make test-ros2` runs; elsewhere they are skipped."""

import os
from pathlib import Path

import pytest

FOLDER = "TORCHELEV_ROS2_FOLDER"  # what `prepare.py` wrote
collect_ignore = [] if FOLDER in os.environ else ["test_launch.py", "test_node.py", "test_outputs.py"]


@pytest.fixture(scope="session")
def prepared():
    return Path(os.environ[FOLDER])


@pytest.fixture(scope="session")
def library(prepared):
    return f"library:={(prepared / 'library').read_text()}"


@pytest.fixture(scope="session", autouse=True)
def context():
    import rclpy

    rclpy.init()
    yield
    rclpy.shutdown()


@pytest.fixture
def make_robot(tmp_path, prepared, library):
    from robot import Robot

    robots = []

    def make(name="", *arguments, config=prepared / "robot.yaml"):
        robot = Robot(config, name, ["-p", library, *arguments])
        robots.append(robot)
        robot.start(tmp_path / f"log{len(robots)}")
        return robot

    yield make
    for robot in robots:
        if robot.process and robot.process.poll() is None:
            robot.stop()
        robot.destroy_node()
