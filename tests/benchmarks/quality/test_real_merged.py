"""The benchmark that merges real scans, on a simulated one."""

import numpy as np

from benchmarks.quality.real import merged
from torchelev.io import Frame


def test_quarters_of_a_scan_are_aligned_and_tabulated():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-8, 8, (60_000, 2))
    points = np.column_stack([xy, 0.1 * np.sin(xy[:, 0]) - 1.0 + rng.normal(0, 0.005, len(xy))]).astype(np.float32)
    frame = Frame(points, np.eye(4), 0.1, "scan")
    row = merged.merge(merged.split(frame, 4))
    assert row["robots"] == 4 and row["offset_error_max"] < 1e-4
    assert row["seam_after"] < 0.01 < 0.05 < row["seam_before"]
    assert "below 0.01 mm" in merged.table([{"recording": "scan", **row, "offset_error_max": 0.0}])
