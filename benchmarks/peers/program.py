"""A peer that is a program, such as one in C++: `python -m benchmarks.peers --program PATH`.

The program reads stdin and writes stdout, in little-endian binary without padding. Logs go to stderr. A matrix `T` is
4 × 4, row by row. The area has H cells along +x and W along +y; values of cells are float32[H][W].

1. The program starts by writing three lines of text: its title, its version (may be empty) and its settings.
2. It reads the setup, which has no answer:

        float64         side of a cell [m]
        float64[2]      x and y of the low corner of the area, map frame [m]
        int32[2]        H and W
        float64         range of the sensor [m]
        float64         height of the sensor over the ground at the start [m]
        int32[2]        width and height of the images of a depth camera [pixels], 0 for another sensor
        float64[4]      its fx, fy, cx, cy [pixels]

3. It answers each request. A request starts with an int64 n. If n >= 0, it is a scan:

        float64         time since the scan before [s]
        float64[16]     T_map_base
        float64[16]     T_map_sensor
        float32[n][3]   points [m], sensor frame: x forward, y left, z up; all finite

   The answer is float64[2]: the time of the update [s], wall clock, and the CPU time of all its threads [s]. The
   program measures both, from the points in its memory to the updated map, so that the pipe is not timed.

   If n = -1, it is a request for the ground. The answer:

        float32[H][W]   height of the ground at each cell, map frame [m], NaN where unknown
        uint8           1 if standard deviations follow, else 0
        float32[H][W]   standard deviations [m]

4. It exits when stdin ends, also before the setup: the command first starts it only for its three lines.

A program is started anew for each recording. Its memory counts from when it has written its three lines.
"""

from __future__ import annotations

import os
import select
import struct
import subprocess
from pathlib import Path

import numpy as np

from benchmarks.peers.peer import Array, Frame, Setup
from benchmarks.peers.process import About, Child
from benchmarks.peers.worker import resident
from torchelev.errors import require

PATIENCE = 60.0  # [s] for an answer


def about_program(path: Path) -> About:
    """Start a program and return what it says of itself. Its name is that of the file, without suffix."""
    path = path.absolute()
    try:
        done = subprocess.run([str(path)], stdin=subprocess.DEVNULL, capture_output=True, timeout=PATIENCE)
        lines = done.stdout.decode(errors="replace").splitlines()
        actual = f"{len(lines)} {done.stderr.decode(errors='replace')}".strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        lines, actual = [], str(error)
    rule, hint = "expected three lines: title, version, settings", "see benchmarks/peers/program.py"
    require(len(lines) == 3, path.name, rule, actual, hint)
    title, version, settings = lines
    return About(path.stem, title, settings, "", "points", version, str(path))


class Program(Child):
    """A program that runs."""

    def __init__(self, peer: About, setup: Setup) -> None:
        super().__init__(peer.title, [peer.program])
        self._cells, about = setup.cells, b""
        while about.count(b"\n") < 3:
            about += self._receive(1, "its three lines")
        self._least = resident(self._process.pid)
        low, pinhole = setup.low, setup.pinhole or (0,) * 6
        ranges = setup.max_range, setup.sensor_height
        self._send(struct.pack("<3d2i2d2i4d", setup.resolution, *low, *setup.cells, *ranges, *pinhole))

    def update(self, frame: Frame) -> tuple[float, float]:
        """Give it a scan; return the seconds that it took, and those of all cores."""
        points = frame.points[np.isfinite(frame.points).all(1)]
        poses = np.stack([frame.T_map_base, frame.T_map_sensor])
        self._send(struct.pack("<qd", len(points), frame.dt), poses.astype("<f8"), points.astype("<f4"))
        return struct.unpack("<2d", self._receive(16, "the times of a scan"))  # type: ignore[return-value]

    def ground(self) -> tuple[Array, Array | None, int]:
        """Return heights [m], their standard deviations or None, and by how much its memory has grown [bytes]."""
        self._send(struct.pack("<q", -1))
        height = self._grid("the heights")
        (has_std,) = self._receive(1, "the flag of standard deviations")
        std = self._grid("the standard deviations") if has_std else None
        return height, std, resident(self._process.pid) - self._least

    def close(self) -> None:
        """End it; refuse bytes that nothing asked for."""
        left = self._end()
        if left:
            raise RuntimeError(f"{self._title} sent {len(left)} bytes too many; see benchmarks/peers/program.py")

    def _grid(self, what: str) -> Array:
        """Receive a value of each cell, float64."""
        height, width = self._cells
        values = np.frombuffer(self._receive(4 * height * width, what), "<f4")
        return values.reshape(height, width).astype(np.float64)

    def _send(self, *parts: bytes | Array) -> None:
        try:
            for part in parts:
                self._process.stdin.write(part if isinstance(part, bytes) else part.tobytes())
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._failed() from None

    def _receive(self, size: int, what: str) -> bytes:
        found, pipe = b"", self._process.stdout.fileno()
        while len(found) < size:
            is_ready = select.select([pipe], [], [], PATIENCE)[0]
            piece = os.read(pipe, size - len(found)) if is_ready else b""
            if not piece:
                self._process.kill()  # it may wait for more of a request
                then = "ended" if is_ready else f"nothing for {PATIENCE:g} s"
                raise self._failed(f"sent {len(found)} of {size} bytes of {what}, then {then}")
            found += piece
        return found
