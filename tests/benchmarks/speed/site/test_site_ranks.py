"""The benchmark of sites that processes share."""

import pytest

from benchmarks.speed.site import site_ranks


@pytest.mark.slow(4)
def test_processes_share_the_robots():
    rows = site_ranks.measure(site_ranks.Sizes(robots=4, merges=2, repeats=1), [1, 2])
    assert [(row["processes"], row["on_disk"]) for row in rows] == [(1, False), (2, False), (1, True), (2, True)]
    assert all(row["median_ms"] > 0 and row["megabytes"] > 0 and len(row["all_ms"][0]) == 3 for row in rows)
    assert len(site_ranks.table({"rows": rows}).split("\n")) == 6
