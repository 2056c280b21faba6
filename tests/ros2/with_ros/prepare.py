"""Write a bag, and its map by `torchelev map`: `python -m tests.ros2.with_ros.prepare FOLDER`, without ROS."""

import subprocess
import sys
from pathlib import Path

from tests.io.bags.synthetic import CLOUD, START, T_BASE_LIDAR, Writer, drive
from torchelev.runtime.library import build_library

CONFIG = """
map_frame: odom
base_frame: base_link
clouds: [/lidar/points]
rate_diagnostics: 200.0
rate_points: 200.0
map: {grid: {resolution: 0.1, length_x: 8.0, length_y: 8.0}}
"""


def main(folder: Path) -> None:
    """Write bag, map, config and the library's path."""
    folder.mkdir(parents=True, exist_ok=True)
    writer, truth = Writer(folder / "drive", "mcap"), drive()
    writer.transform(START - 0.3, "base_link", "lidar", T_BASE_LIDAR.numpy(), is_static=True)
    for stamp, T in zip(truth.stamps, truth.bases, strict=True):
        writer.transform(stamp, "odom", "base_link", T)
    for scan in truth.clouds:
        writer.cloud(scan._replace(times=None))
    writer.close()
    (folder / "robot.yaml").write_text(CONFIG)
    (folder / "map.yaml").write_text("grid: {resolution: 0.1, length_x: 8.0, length_y: 8.0}\n")
    options = ["--points", CLOUD, "--map-frame", "odom", "--base-frame", "base_link", "--config", folder / "map.yaml"]
    command = [sys.executable, "-m", "torchelev", "map", folder / "drive", *options, "--out", folder / "map"]
    subprocess.run([str(part) for part in command], check=True)
    (folder / "library").write_text(build_library()._name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
