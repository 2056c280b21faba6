"""The results that the tables of the pages read."""

import json
from pathlib import Path
from typing import Any

import benchmarks

GPU = "gpu-nvidia-h100-80gb-hbm3"
SPEED = "speed-2-x-amd-epyc-2-threads"


def load(name: str, folder: Path = benchmarks.RESULTS) -> dict[str, Any]:
    """Read a result."""
    return json.loads((folder / f"{name}.json").read_text())
