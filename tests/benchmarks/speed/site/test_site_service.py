"""The service that is timed: all windows of all robots are merged, and the table has a line for each case."""

import pytest

pytest.importorskip("zenoh")

from benchmarks.speed.site import site_service


@pytest.mark.slow(8)
def test_every_window_has_a_latency(monkeypatch):
    monkeypatch.setattr(site_service, "ROBOTS", 2)
    row = site_service.measure("files", at_once=True, seconds=5)
    assert row["windows"] == 2 * (5 - site_service._WARM_UP) and 0 < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
    assert 20e3 < row["bytes_per_window"] < 300e3
    assert len(site_service.table({"rows": [row]}).split("\n")) == 3
