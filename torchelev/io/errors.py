"""The one error that reading a recording raises."""

from __future__ import annotations

from pathlib import Path


class RecordingError(ValueError):
    """A recording cannot be read: one line with the file, what is wrong with it, and what to do."""

    def __init__(self, path: str | Path, problem: str, mend: str = "") -> None:
        line = f"{path}: {problem}" + (f"; {mend}" if mend else "")
        super().__init__(" ".join(line.split()))
        self.path = Path(path)
