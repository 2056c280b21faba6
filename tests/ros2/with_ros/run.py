"""Run the tests in each ROS 2 and middleware of the wheel isaacsim-ros2: `python run.py FOLDER [pytest's options]`.

`python run.py FOLDER measure JSON MINUTES` runs measure.py in Jazzy instead.
"""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

HERE = Path(__file__).resolve().parent
WHEEL = Path(sysconfig.get_path("purelib")) / "isaacsim" / "exts" / "isaacsim.ros2.core"


def environment(distribution: str, middleware: str, prepared: Path) -> dict[str, str]:
    """Return what setup.bash would set."""
    folder = WHEEL / distribution
    alone = {"ROS_LOCALHOST_ONLY": "1"} if distribution == "humble" else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return (
        os.environ
        | alone
        | {
            "ROS_DISTRO": distribution,
            "LD_LIBRARY_PATH": str(folder / "lib"),
            "PYTHONPATH": os.pathsep.join(map(str, (HERE.parents[2], HERE, folder / "rclpy"))),
            "AMENT_PREFIX_PATH": str(folder),
            "RMW_IMPLEMENTATION": middleware,
            "TORCHELEV_ROS2_FOLDER": str(prepared.resolve()),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # those of ROS need more packages
        }
    )


def main(prepared: Path, options: list[str]) -> int:
    """Return 0 if all tests passed in all of them."""
    failed = []
    for distribution in ("humble", "jazzy"):
        for middleware in ("rmw_fastrtps_cpp", "rmw_cyclonedds_cpp"):
            print(f"{distribution}, {middleware}", flush=True)
            command = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider"]
            command += [f"--confcutdir={HERE}", "--import-mode=importlib", str(HERE), *options]
            if subprocess.run(command, env=environment(distribution, middleware, prepared), cwd=prepared).returncode:
                failed.append(f"{distribution}, {middleware}")
    print("all passed" if not failed else f"failed: {'; '.join(failed)}")
    return bool(failed)


def measure(prepared: Path, out: Path, minutes: str) -> int:
    """Return the exit code of measure.py."""
    command = [sys.executable, HERE / "measure.py", prepared.resolve(), out.resolve(), minutes]
    return subprocess.run(command, env=environment("jazzy", "rmw_fastrtps_cpp", prepared)).returncode


if __name__ == "__main__":
    if sys.argv[2:3] == ["measure"]:
        sys.exit(measure(Path(sys.argv[1]), Path(sys.argv[3]), sys.argv[4]))
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
