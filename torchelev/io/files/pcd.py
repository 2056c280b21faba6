"""Read PCD files by pypcd4, with headers that it refuses and PCL writes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.frames import transform
from torchelev.io.errors import RecordingError
from torchelev.io.files.arrays import CloudFile, from_fields

_PER_FIELD = ("FIELDS", "SIZE", "TYPE", "COUNT")
_MAX_HEADER = 64  # lines


def read_pcd(path: Path, frame: str | None) -> CloudFile:
    """Read a `.pcd`, whose points are in the `frame` "sensor" or "viewpoint"; None: VIEWPOINT must be the identity."""
    cloud = _parse(path)
    num_points = cloud.metadata.points
    if len(cloud.pc_data) != num_points:
        raise RecordingError(path, f"cut short: {len(cloud.pc_data)} of {num_points} points", "copy the file again")
    read = from_fields(path, cloud.pc_data)
    return read._replace(points=_to_sensor_frame(path, read.points, cloud.metadata.viewpoint, frame))


def _parse(path: Path) -> Any:
    from pypcd4 import PointCloud

    try:
        return PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(_repair_header(path.read_bytes()))))
    except Exception as error:  # raised by pypcd4, NumPy, pydantic or lzf, depending on what is damaged
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(path, f"cut short or not a .pcd file ({detail})", "export it again") from error


def _repair_header(content: bytes) -> bytes:
    """Return a file without fields of COUNT 0, which take no bytes, and with a COUNT for each field."""
    lines: list[str] = []
    position = 0
    while len(lines) < _MAX_HEADER and (end := content.find(b"\n", position)) >= 0:
        lines.append(content[position:end].decode("ascii", errors="replace").strip())
        position = end + 1
        if lines[-1].upper().startswith("DATA"):
            return "".join(f"{line}\n" for line in _keep_counted(lines)).encode() + content[position:]
    return content


def _keep_counted(lines: list[str]) -> list[str]:
    rows = {words[0].upper(): words[1:] for words in map(str.split, lines) if words}
    fields = rows.get("FIELDS", [])
    counts = rows.get("COUNT", ["1"] * len(fields))
    if any(len(rows.get(name, counts)) != len(fields) for name in _PER_FIELD):
        return lines  # damaged: pypcd4 says how
    kept = [k for k, count in enumerate(counts) if count != "0"]
    table = {**{name: rows[name] for name in _PER_FIELD if name in rows}, "COUNT": counts}
    others = [line for line in lines[:-1] if not line.upper().startswith(_PER_FIELD)]
    return [*others, *(" ".join([name, *(row[k] for k in kept)]) for name, row in table.items()), lines[-1]]


def _to_sensor_frame(path: Path, points: NDArray, viewpoint: tuple[float, ...], frame: str | None) -> NDArray:
    """Return points (N, 3) in the sensor frame.

    VIEWPOINT is the sensor's pose, but programs differ on whether the points are in its frame or in the sensor's.
    """
    position, quat_wxyz = np.array(viewpoint[:3]), np.array(viewpoint[3:])
    is_identity = np.allclose(position, 0) and np.allclose(np.abs(quat_wxyz), [1, 0, 0, 0])
    if is_identity or frame == "sensor":
        return points
    if frame is None:
        numbers = " ".join(f"{v:g}" for v in viewpoint)
        problem = f"VIEWPOINT {numbers}: the points may be in the sensor's frame or in the frame of this pose"
        raise RecordingError(path, problem, "say which with --pcd-frame sensor or --pcd-frame viewpoint")
    norm = np.linalg.norm(quat_wxyz)
    if not abs(norm - 1) < 0.02:
        raise RecordingError(path, f"VIEWPOINT's quaternion has length {norm:g}, not 1", "use --pcd-frame sensor")
    T_view_sensor = transform(position, quat_wxyz / norm).numpy()
    return (points - position) @ T_view_sensor[:3, :3]
