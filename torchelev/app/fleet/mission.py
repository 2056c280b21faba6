"""The mission: robots walk, see, map what is around them, and merge their maps into the site's."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchelev.app.fleet.explore import Explorer, coarsen
from torchelev.app.fleet.request import FleetRequest
from torchelev.app.fleet.robots import Robots
from torchelev.app.fleet.world import World
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.grid import GridConfig
from torchelev.site import SiteMap

if TYPE_CHECKING:
    from torchelev.app.fleet.service import FleetService
    from torchelev.io.export import SavedMap

DT = 0.2  # [s] between scans
SCANS_PER_MERGE = 5


class Mission:
    """A fleet's exploration of one area.

    Args:
        request: what to simulate.
        folder: of the site map; None: in memory.

    Attributes:
        time: [s] since the first scan.
        scan: what all robots saw last.
        saved: the area as the site map knows it; None before the first merge.
        coverage: share of the area's cells that are known.
        report: of the last merge.
        height_errors: (B,) [m] true height errors of the robots' poses at the last merge.
        history: time [s] and coverage of each merge.
        contradictions: how often a robot contradicted the site or another robot at a cell, in all merges.
        update_ms: times of all updates [ms].
        merge_ms: times of all merges [ms].
    """

    def __init__(self, request: FleetRequest, folder: Path | None) -> None:
        self.request = request
        self.world = World(request.size, request.camp_radius, request.seed)
        self.robots = Robots(self.world, request.robots, request.seed)
        self.explorer = Explorer(request.robots, request.size, request.coarse)
        grid = GridConfig(resolution=request.resolution, length_x=request.window, length_y=request.window)
        self.emap = ElevationMap(ElevationMapConfig(grid=grid), num_envs=request.robots)
        self.site = open_site(request, self.emap, folder)
        self.time, self.coverage = 0.0, 0.0
        self.num_scans, self._num_unmerged = 0, 0
        self.saved: SavedMap | None = None
        self.history: list[tuple[float, float]] = []
        self.contradictions = 0
        self.update_ms: list[float] = []
        self.merge_ms: list[float] = []

    @property
    def is_done(self) -> bool:
        """Whether time is up, or nothing is left to explore."""
        return self.time >= self.request.seconds - DT / 2 or self.explorer.is_done

    def step(self) -> None:
        """Walk and map for the time of one scan; merge and choose new goals if it is time to."""
        if self.num_scans:
            self.robots.walk(DT)
        scan = self.robots.sense(DT)
        start = time.perf_counter()
        self.emap.update(scan.points, scan.T_map_sensor, scan.T_map_base, DT)
        self.update_ms.append(1e3 * (time.perf_counter() - start))
        self.scan, self.time = scan, DT * self.num_scans
        self.num_scans, self._num_unmerged = self.num_scans + 1, self._num_unmerged + 1
        if self._num_unmerged == SCANS_PER_MERGE or self.saved is None:
            self.merge()
            self._plan()

    def merge(self) -> None:
        """Merge all robots' maps into the site map."""
        start = time.perf_counter()
        self._num_unmerged = 0
        self.report = self.site.merge(self.emap)
        self.merge_ms.append(1e3 * (time.perf_counter() - start))
        self.contradictions += int(self.report.contradictions.sum())
        self.height_errors = self.scan.height_error
        self.saved = self.site.window((0.0, 0.0), self.request.size, self.request.size)
        self.coverage = float(np.isfinite(self.saved.layers["elevation"]).mean())
        self.history.append((round(self.time, 3), self.coverage))

    def finish(self) -> None:
        """Merge what was seen since the last merge."""
        if self._num_unmerged:
            self.merge()

    def _plan(self) -> None:
        """Choose goals and paths from what the site map knows."""
        assert self.saved is not None
        area = coarsen(torch.as_tensor(self.saved.layers["elevation"]), self.request.resolution)
        self.robots.follow(self.explorer.plan(area, self.robots.xy))


def open_site(request: FleetRequest, emap: ElevationMap, folder: Path | None) -> SiteMap | FleetService:
    """Open the site map, in this process or as a service."""
    if not request.is_served:
        return SiteMap(resolution=request.resolution, path=folder)
    from torchelev.app.fleet.service import FleetService
    from torchelev.site.storage.zarr_files import import_tensorstore

    import_tensorstore()
    assert folder is not None
    return FleetService(emap, folder, request.seconds)
