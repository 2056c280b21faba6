"""The error that reading a recording raises."""

from __future__ import annotations

from pathlib import Path


class RecordingError(ValueError):
    """A recording cannot be read. The message is one line: file, problem, hint."""

    def __init__(self, path: str | Path, problem: str, hint: str = "") -> None:
        line = f"{path}: {problem}" + (f"; {hint}" if hint else "")
        super().__init__(" ".join(line.split()))
        self.path = Path(path)
