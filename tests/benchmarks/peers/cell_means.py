"""A program for `benchmarks/peers/program.py`: the mean height of each cell."""

import struct
import sys
import time

import numpy as np


def main():
    """Answer requests until stdin ends."""
    given, answers = sys.stdin.buffer, sys.stdout.buffer
    answers.write(b"means of a program\n1.2\nall points weigh the same\n")
    answers.flush()
    setup = given.read(88)
    if not setup:
        return
    resolution, *low, height, width = struct.unpack("<3d2i", setup[:32])
    total, count = np.zeros((height, width)), np.zeros((height, width))
    while head := given.read(8):
        (n,) = struct.unpack("<q", head)
        if n < 0:
            mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
            answers.write(mean.astype("<f4").tobytes() + b"\0")
        else:
            poses = np.frombuffer(given.read(8 + 2 * 128)[8:], "<f8").reshape(2, 4, 4)
            points = np.frombuffer(given.read(12 * n), "<f4").reshape(-1, 3)
            assert np.isfinite(points).all()
            start, cpu = time.perf_counter(), time.process_time()
            placed = points.astype(np.float64) @ poses[1, :3, :3].T + poses[1, :3, 3]
            i, j = np.floor((placed[:, :2] - low) / resolution).astype(int).T
            inside = (i >= 0) & (i < height) & (j >= 0) & (j < width)
            np.add.at(total, (i[inside], j[inside]), placed[inside, 2])
            np.add.at(count, (i[inside], j[inside]), 1)
            answers.write(struct.pack("<2d", time.perf_counter() - start, time.process_time() - cpu))
        answers.flush()


if __name__ == "__main__":
    main()
