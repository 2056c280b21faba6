"""A node's map by PyTorch: `ElevationMap`."""

from __future__ import annotations

import copy
import json
import math
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.config import ElevationMapConfig
from torchelev.diagnosis.causes import diagnose
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.io.map_file import load_map, save_map
from torchelev.levels.config import levels_with_ceilings
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.scan.presets import PRESETS
from torchelev.ros2.engine import PathAnswer, SensorInput, Window
from torchelev.ros2.settings import NodeSettings
from torchelev.state import map_layers

_MAX_FOOTPRINTS = 20_000  # of a path, a second or two


class Diagnosis:
    """Diagnoses a map beside its updates: it takes 100 ms, in which a policy would wait for its height scan."""

    PAUSE = 5.0  #: [s] from one to the next

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1)
        self._running: Future[list[str]] | None = None
        self._began, self._findings = -math.inf, list[str]()

    def findings(self, emap: ElevationMap) -> list[str]:
        """Return what the last one found, and begin the next one if it is time."""
        if self._running is not None and self._running.done():
            self._findings, self._running = self._running.result(), None
        if self._running is None and time.monotonic() - self._began >= self.PAUSE:
            self._began = time.monotonic()
            copies = map_layers(Tensor.clone, emap.state), copy.deepcopy(emap._history)
            self._running = self._pool.submit(diagnose, emap.cfg, *copies)
        return self._findings


class TorchEngine:
    """One environment of an `ElevationMap`."""

    def __init__(self, cfg: dict[str, Any], settings: NodeSettings) -> None:
        torch.set_num_threads(settings.threads)
        self._map = ElevationMap(ElevationMapConfig.from_dict(cfg))
        self._map.compile()  # now, not at the first cloud
        self._scan = _scan_of(settings.height_scan)
        self._diagnosis = Diagnosis()
        self.links = list(self._map.cfg.sensor.links)
        self.levels = levels_with_ceilings(self._map.cfg.levels)
        self._height = settings.robot_height or None

    def update(self, given: SensorInput) -> None:
        """Fuse the points of one sensor."""
        known = {"pose_covariance": given.pose_covariance, "T_base_links": given.T_base_links}
        more = {name: _floats(value) for name, value in known.items() if value is not None}
        points = torch.from_numpy(given.points)[None]
        self._map.update(points, _floats(given.T_map_sensor), _floats(given.T_map_base), given.dt, **more)

    def window(self) -> Window:
        """Return where the cells lie."""
        grid, corner = self._map.cfg.grid, self._map.state.corner[0].tolist()
        place = corner[0] * grid.resolution, corner[1] * grid.resolution
        return Window(place, grid.resolution, (grid.height, grid.width))

    def layer(self, name: str) -> NDArray[np.float32]:
        """Return a layer (H, W), NaN where unknown; ValueError if there is none of this name."""
        try:
            return self._map.layer(name)[0].cpu().numpy()
        except KeyError as error:
            raise ValueError(error.args[0]) from error

    def scan(self, T_map_base: NDArray) -> NDArray[np.float32]:
        """Return the values (P,) of the height scan."""
        return self._scan(self._map, _floats(T_map_base))[0][0].cpu().numpy()

    def statistics(self) -> dict[str, float]:
        """Return what the last update did."""
        return {name: value.item() for name, value in self._map.statistics._asdict().items()}

    def diagnose(self) -> list[str]:
        """Return what looks wrong with the inputs, as of some seconds ago."""
        return self._diagnosis.findings(self._map)

    def planes(self) -> list[Any]:
        """Return the planar regions."""
        from torchelev.planes import segment  # which few nodes are asked for

        center = self._map.center[0, :2].numpy()
        return list(segment(self._map.layer("elevation"), self._map.cfg.grid.resolution, center=center)[0].regions)

    def check_path(
        self, poses: NDArray[np.float64], footprint: NDArray[np.float64], T_map_base: NDArray[np.float64] | None
    ) -> PathAnswer:
        """Move a footprint (V, 2) [m] along poses (T, 3), x, y [m] and yaw [rad]."""
        from torchelev.planning.footprint import FootprintConfig  # which few nodes are asked for
        from torchelev.planning.path_check import check_path, count_samples
        from torchelev.planning.standing import place_footprint

        corners = torch.from_numpy(footprint)
        standing = torch.full((1, len(footprint), 2), torch.nan, dtype=torch.float64)  # it is not known where it stands
        if T_map_base is not None:
            standing = place_footprint(self._map, corners, _floats(T_map_base)[:, None])[:, 0]
        cfg = FootprintConfig(max_extent=2.01 * float(np.hypot(*footprint.T).max()), height=self._height)
        path = _floats(poses)
        samples = count_samples(self._map, path, corners)
        hint, rule = (
            "give poses every few centimetres, as planners do",
            f"must need at most {_MAX_FOOTPRINTS} footprints",
        )
        require(samples * len(poses) <= _MAX_FOOTPRINTS, "path", rule, samples * len(poses), hint)
        checked = check_path(self._map, path, corners, cfg, samples=samples, standing=standing)
        safe = checked.footprints.safe[0].numpy()
        # A pose is reached by the samples after the one before.
        unsafe = [k for k in range(len(poses)) if not safe[max(0, (k - 1) * samples + 1) : k * samples + 1].all()]
        return PathAnswer(not unsafe, unsafe, checked.explain()[0])

    def initialize_from(self, site: Path, T_map_base: NDArray[np.float64]) -> None:
        """Start with what a site map knows."""
        from torchelev.site import SiteMap  # which few nodes are asked for

        self._map.initialize_from(SiteMap.open(site, read_only=True), _floats(T_map_base))

    def reset(self) -> None:
        """Forget everything."""
        self._map.reset()

    def clear_around(self, center: NDArray[np.float64], radius: float) -> None:
        """Forget the cells within a radius [m] of a place (2,) [m]."""
        self._map.clear_around(_floats(center), radius)

    def initialize(self, feet: NDArray[np.float64], method: str, T_map_base: NDArray[np.float64]) -> None:
        """Estimate the unknown cells around the robot from ground points (K, 3) [m]."""
        links = {"T_base_links": torch.eye(4).repeat(1, len(self.links), 1, 1)} if self.links else {}
        nothing, T = torch.full((1, 1, 3), torch.nan), _floats(T_map_base)
        self._map.update(nothing, T, T, 0.0, **links)  # moves the window
        self._map.initialize(_floats(feet), method)

    def save(self, path: Path) -> None:
        """Save the map."""
        save_map(path, self._map)

    def load(self, path: Path) -> None:
        """Load a map that was saved."""
        saved = load_map(path)
        fits = saved.cfg == self._map.cfg
        require(
            fits, "map_file", "must be a map of the same settings", str(path), "load it with those it was saved with"
        )
        self._map.load_state(saved.state)


def _scan_of(layout: str) -> HeightScan:
    """Return the scan of a preset's name, or of a layout as JSON."""
    if layout in PRESETS:
        return HeightScan.preset(layout)
    try:
        given = json.loads(layout)
        return HeightScan(**given)
    except (ValueError, TypeError) as error:
        rule = f"must be one of {', '.join(PRESETS)}, or a layout as JSON"
        raise ValueError(f"height_scan: {rule}, got {layout!r} ({error}); use isaac_lab") from error


def _floats(values: NDArray) -> Tensor:
    """Return float64 values of one environment."""
    return torch.from_numpy(np.ascontiguousarray(values, np.float64))[None]
