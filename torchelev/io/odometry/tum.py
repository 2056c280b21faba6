"""Write poses as a TUM file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.files.output_files import atomic_file


def write_tum(path: str | Path, stamps: NDArray[np.float64], rows: Iterable[Iterable[float]], comment: str) -> None:
    """Write one line for each pose: the stamp [s], x, y, z [m] and the quaternion x, y, z, w, with nine decimals.

    Args:
        path: file to write.
        stamps: (K,) [s].
        rows: K times x, y, z and the quaternion x, y, z, w.
        comment: says whose pose in which frame this is.

    Raises:
        WriteError: the file cannot be written.
    """
    lines = [f"# {comment}", "# timestamp tx ty tz qx qy qz qw"]
    for stamp, row in zip(stamps, rows, strict=True):
        lines.append(" ".join(f"{value:.9f}" for value in (stamp, *row)))
    with atomic_file(path) as file:
        file.write(("\n".join(lines) + "\n").encode())
