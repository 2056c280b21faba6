"""A node's map by PyTorch: `ElevationMap`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.io.map_file import load_map, save_map
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.presets import PRESETS
from torchelev.ros2.engine import Window
from torchelev.ros2.settings import NodeSettings


class TorchEngine:
    """One environment of an `ElevationMap`."""

    def __init__(self, cfg: dict[str, Any], settings: NodeSettings) -> None:
        torch.set_num_threads(settings.threads)
        self._map = ElevationMap(ElevationMapConfig.from_dict(cfg))
        self._map.compile()  # now, not at the first cloud
        self._scan = _scan_of(settings.height_scan)

    def update(self, points: NDArray, T_map_sensor: NDArray, T_map_base: NDArray, dt: float) -> None:
        """Fuse points (N, 3) of one sensor."""
        self._map.update(torch.from_numpy(points)[None], _pose(T_map_sensor), _pose(T_map_base), dt)

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
            raise ValueError(str(error)) from error

    def scan(self, T_map_base: NDArray) -> NDArray[np.float32]:
        """Return the values (P,) of the height scan."""
        return self._scan(self._map, _pose(T_map_base))[0][0].cpu().numpy()

    def statistics(self) -> dict[str, float]:
        """Return what the last update did."""
        return {name: value.item() for name, value in self._map.statistics._asdict().items()}

    def diagnose(self) -> list[str]:
        """Return what looks wrong with the inputs."""
        return self._map.diagnose()

    def reset(self) -> None:
        """Forget everything."""
        self._map.reset()

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


def _pose(T: NDArray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(T, np.float64))[None]
