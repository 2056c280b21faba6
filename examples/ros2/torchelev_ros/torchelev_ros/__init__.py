"""The executable `elevation_mapping` of this package: torchelev's own node, `torchelev ros2`."""

import os
import shutil
import sys


def main() -> None:
    """Become `torchelev ros2` with the arguments of this process.

    The command in PATH comes first: it belongs to the virtual environment that is active, and this process runs in the
    Python that colcon built with.
    """
    command = shutil.which("torchelev")
    if command:
        os.execv(command, [command, "ros2", *sys.argv[1:]])
    try:
        from torchelev.__main__ import run
    except ModuleNotFoundError as error:
        sys.exit(f"Error: {error} in {sys.executable}, nor torchelev in PATH; activate its virtual environment")
    sys.argv = ["torchelev", "ros2", *sys.argv[1:]]
    run()
