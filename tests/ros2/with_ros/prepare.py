"""Write bags, and their maps by `torchelev map`: `python -m tests.ros2.with_ros.prepare FOLDER`, without ROS."""

import shutil
import subprocess
import sys
from pathlib import Path

from tests.io.bags.synthetic import CLOUD, DEPTH, START, T_BASE_CAMERA, T_BASE_LIDAR, Writer, drive
from torchelev.runtime.library import build_library

CONFIG = """
map_frame: odom
base_frame: base_link
clouds: [/lidar/points]
rate_diagnostics: 200.0
rate_points: 200.0
map: {grid: {resolution: 0.1, length_x: 8.0, length_y: 8.0}}
"""


BAGS = ("still", "timed", "depth")  #: clouds taken at once, clouds with a time for each point, and depth images


def main(folder: Path) -> None:
    """Write bags and their maps, config and the library's path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.yaml").write_text(CONFIG)
    (folder / "map.yaml").write_text("grid: {resolution: 0.1, length_x: 8.0, length_y: 8.0}\n")
    for name in BAGS:
        write_bag(folder / name, name)
        source = ["--depth", DEPTH] if name == "depth" else ["--points", CLOUD]
        options = [*source, "--map-frame", "odom", "--base-frame", "base_link", "--config", folder / "map.yaml"]
        command = [sys.executable, "-m", "torchelev", "map", folder / name, *options, "--out", folder / f"{name}_map"]
        subprocess.run([str(part) for part in command], check=True)
    (folder / "library").write_text(build_library()._name)


def write_bag(path: Path, name: str) -> None:
    """Write the drive with one kind of sensor."""
    shutil.rmtree(path, ignore_errors=True)
    writer, truth = Writer(path, "mcap"), drive()
    for frame, T in (("lidar", T_BASE_LIDAR), ("camera", T_BASE_CAMERA)):
        writer.transform(START - 0.3, "base_link", frame, T.numpy(), is_static=True)
    for stamp, T in zip(truth.stamps, truth.bases, strict=True):
        writer.transform(stamp, "odom", "base_link", T)
    if name == "depth":
        writer.camera_info(START)
        for scan, image in truth.depths:
            writer.depth(scan.stamp, image)
    else:
        for scan in truth.clouds:
            writer.cloud(scan if name == "timed" else scan._replace(times=None))
    writer.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
