"""The timing of rays among structures."""

import pytest

from benchmarks.speed import structures


@pytest.mark.slow(3)
def test_times_every_sensor_with_boxes_and_without():
    rows = structures.measure(0.01, robots=4, tiles=2)
    assert len(rows) == 4 * len(structures.SENSORS)
    assert {row["boxes"] > 0 for row in rows} == {True, False} and all(row["median"] > 0 for row in rows)


def test_the_table_compares_with_no_boxes():
    rows = [
        {"sensor": "camera", "boxes": boxes, "code": "C++", "median": median, "min": 1.0}
        for boxes, median in ((0.0, 2.0), (28.2, 3.0))
    ]
    lines = structures.table({"rows": rows}).split("\n")
    assert lines[3] == "| camera | 28 | C++ | 3.0 | 1.0 | 1.50 |"
