"""Builds of the C library and its examples by CMake, and streams that the examples map."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import torch

from benchmarks.speed.common.workload import BPEARL, Drive, full_config
from torchelev.kernels.registry import PACKAGE
from torchelev.runtime.stream import write_instant

RUNTIME = PACKAGE / "runtime"
PROGRAMS = "step", "loop"


def run(*command: Any, **options: Any) -> subprocess.CompletedProcess[bytes]:
    """Run a command; raise RuntimeError with what it printed if it fails."""
    done = subprocess.run([str(part) for part in command], capture_output=True, **options)
    if done.returncode:
        raise RuntimeError(
            f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stderr.decode()[-4000:]}"
        )
    return done


def build(folder: Path, *settings: str) -> dict[str, Path]:
    """Build library and examples with these settings of CMake; return the examples by name."""
    run("cmake", "-S", RUNTIME, "-B", folder, "-DTORCHELEV_EXAMPLES=ON", *settings)
    run("cmake", "--build", folder, "--parallel")
    return {name: folder / "examples" / f"torchelev_{name}" for name in PROGRAMS}


def write_stream(path: Path, count: int, sensors: int = 1, points: int = BPEARL) -> None:
    """Record a drive of the speed benchmarks: so many scans of several sensors that share the points."""
    drive = Drive(full_config(), points)
    with path.open("wb") as file:
        for _ in range(count):
            cloud, T = drive.next_scan()
            each = cloud.shape[1] // sensors
            parts = cloud[0, : sensors * each].view(sensors, each, 3)
            write_instant(file, parts.numpy(), T.expand(sensors, 4, 4).numpy(), T[0].numpy(), 0.02)


def write_config(path: Path) -> None:
    """Write the config of the speed benchmarks."""
    full_config().save(path)


def compiler() -> str:
    """Return the compiler's name and version."""
    return run("c++", "--version").stdout.decode().splitlines()[0]


def machine() -> dict[str, Any]:
    """Describe what a figure depends on."""
    return {"compiler": compiler(), "torch": torch.__version__}
