"""The shared sites that are timed: all processes merge their share, and the table has a line for each."""

import pytest

from benchmarks.speed.site import site_ranks


@pytest.mark.slow(6)
def test_every_number_of_processes_has_a_line():
    rows = [site_ranks._measure(4, size, on_disk=False, merges=3) for size in (1, 2)]
    assert [row["processes"] for row in rows] == [1, 2] and all(row["median_ms"] > 0 for row in rows)
    assert rows[0]["bytes"] == 0 and rows[1]["bytes"] == 4 * (120 * 120 * 32.625 + 88)
    assert len(site_ranks.table({"rows": rows}).split("\n")) == 4


def test_the_shares_are_all_robots():
    corners = [
        tuple(corner) for share in ((0, 3), (3, 7)) for corner in site_ranks._robots(range(*share), 7).corner.tolist()
    ]
    assert len(set(corners)) == 7
