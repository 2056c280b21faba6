"""The one error that reading a recording raises."""

from __future__ import annotations

from pathlib import Path


class RecordingError(ValueError):
    """A recording cannot be read: one line with the file, what is wrong with it, and what to do."""

    def __init__(self, path: str | Path, problem: str, hint: str = "") -> None:
        line = f"{path}: {problem}" + (f"; {hint}" if hint else "")
        super().__init__(" ".join(line.split()))
        self.path = Path(path)
