"""Results of benchmarks and trainings: JSON with machine, versions and commit, and Markdown tables."""

from __future__ import annotations

import json
import math
import platform
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch


def machine() -> dict[str, Any]:
    """Return the machine, the versions and the commit that a result belongs to."""
    return {
        "processor": _processor(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": commit(),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.processor()


def commit() -> str:
    """Return the short hash of the checkout's commit, followed by "+changes" if the working tree differs from it."""
    try:
        name = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
        paths = ["torchelev", "envs", "training/**.py", "benchmarks/**.py"]
        status = ["git", "status", "--porcelain", "-uno", *paths]
        changes = subprocess.run(status, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return name.stdout.strip() + ("+changes" if changes.stdout.strip() else "")


def write_json(path: str | Path, values: dict[str, Any]) -> None:
    """Write a result as JSON, with the machine it was measured on; create the folder if needed."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    described = {"machine": None} | values | {"machine": machine()}  # not the machine of an older file
    Path(path).write_text(to_json(described))


def to_json(values: Any) -> str:
    """Return values as strict JSON, which has no NaN and no infinity: null takes their place."""
    return json.dumps(_finite(values), indent=1, allow_nan=False) + "\n"


def _finite(values: Any) -> Any:
    """Replace all floats within dicts, lists and tuples that are not finite by None."""
    if isinstance(values, dict):
        return {name: _finite(value) for name, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [_finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def slug(name: str) -> str:
    """Return a name in lower case for use in file names: letters and digits, joined by hyphens."""
    return "-".join(re.findall(r"[a-z0-9]+", name.lower()))


def align(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of text as lines whose columns are aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def markdown_table(head: list[str], rows: list[list[str]]) -> str:
    """Format a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
