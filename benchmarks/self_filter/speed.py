"""Time an update of many robots without a self-filter, with one box, and with the shapes of 13 links."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

from benchmarks.self_filter.robot import Scan, make_body, make_cameras, walk
from benchmarks.speed.common.meter import interleaved
from torchelev import BodyConfig, ElevationMap, ElevationMapConfig, GridConfig, RobotBody, SensorConfig

ROBOTS = 256
SCANS = 10  # they repeat: two steps of the trot
BODIES: dict[str, BodyConfig | RobotBody | None] = {
    "no body": None,
    "one box": BodyConfig(lower=(-0.3, -0.2, -0.25), upper=(0.3, 0.2, 0.1)),
    "17 shapes of 13 links": make_body(),
}


def _updates(body: BodyConfig | RobotBody | None, scans: list[Scan], compiled: bool) -> Callable[[], None]:
    """Return the next update of a map as a call."""
    grid = GridConfig(resolution=0.04, length_x=2.56, length_y=2.56)
    cfg = ElevationMapConfig(grid=grid, sensor=SensorConfig(body=body))
    emap = ElevationMap(cfg, len(scans[0].points))
    if compiled:
        emap.compile()
    endless = itertools.cycle(scans)

    def update() -> None:
        scan = next(endless)
        links = scan.T_base_links if cfg.sensor.links else None
        emap.update(scan.points, scan.T_map_sensor, scan.T_map_base, dt=0.1, T_base_links=links)

    return update


def measure(seconds: float, robots: int = ROBOTS, compiled: bool = True, num_scans: int = SCANS) -> dict[str, Any]:
    """Time the updates of maps of 64 x 64 cells in turn, and what each takes beyond the one without a body."""
    scans = walk(robots, num_scans, make_cameras())
    runs = {name: _updates(body, scans, compiled) for name, body in BODIES.items()}
    for run in runs.values():
        for _ in range(num_scans):
            run()
    times = interleaved(runs, seconds, rounds=10)
    plain = times["no body"]
    rows = {name: row | {"extra": row["median"] / plain["median"] - 1} for name, row in times.items()}
    return {"robots": robots, "points": scans[0].points.shape[1:3].numel(), "compiled": compiled, "rows": rows}
