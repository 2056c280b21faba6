"""Run an example in the simulator that it needs."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run_example(name, folder, *options):
    """Run an example with few steps; return the last line that it prints. It must write a picture."""
    script = [ROOT / "examples" / f"{name}.py", "--steps", "5", "--picture", folder / "picture.png", *options]
    command = [sys.executable, "-W", "ignore", *map(str, script)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert (folder / "picture.png").read_bytes().startswith(b"\x89PNG")
    return result.stdout
