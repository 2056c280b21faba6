"""A node's map by the C library, without PyTorch."""

from __future__ import annotations

import ctypes.util
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.files.config_files import to_json
from torchelev.levels.config import LevelsConfig, levels_with_ceilings
from torchelev.ros2.engine import PathAnswer, SensorInput, Window
from torchelev.ros2.settings import NodeSettings

_NEEDS_TORCH = "{}: needs PyTorch, and the node's engine is the C library; install torch, or set engine to torch"


def find_library(path: str) -> Path:
    """Return the path of libtorchelev: the given one, that of the wheel for this processor, or the system's."""
    if path:
        return Path(path)
    from torchelev.kernels.cpu_build import AHEAD, instruction_set

    shipped = sorted(AHEAD.glob(f"torchelev-*-{instruction_set()}.so"))
    if shipped:
        return shipped[-1]
    found = ctypes.util.find_library("torchelev")
    hint = (
        "build it with CMake from torchelev/runtime and set the parameter library, or install a wheel that carries it"
    )
    require(found is not None, "library", "must be libtorchelev", f"none for {platform.machine()}", hint)
    return Path(str(found))


class LibraryEngine:
    """A map of the C library."""

    def __init__(self, cfg: dict[str, Any], settings: NodeSettings) -> None:
        from torchelev.runtime.library import CMap, open_library

        library = open_library(find_library(settings.library))
        self._map = CMap(library, json.dumps(to_json(cfg)), settings.max_points, 1, settings.threads)
        try:
            self._scan = self._map.scan(settings.height_scan)
        except ValueError as error:  # it calls the parameter a layout
            raise ValueError(f"height_scan: {str(error).partition(': ')[2]}") from error
        self.links = self._map.links
        levels = cfg.get("levels")
        self.levels = levels_with_ceilings(None if levels is None else LevelsConfig(**levels))

    def update(self, given: SensorInput) -> None:
        """Fuse the points of one sensor."""
        covariance = None if given.pose_covariance is None else given.pose_covariance[None]
        more = {"T_base_links": given.T_base_links, "pose_covariance": covariance}
        self._map.update(given.points[None], given.T_map_sensor[None], given.T_map_base, given.dt, **more)

    def window(self) -> Window:
        """Return where the cells lie."""
        return Window(self._map.corner, self._map.resolution, self._map.size)

    def layer(self, name: str) -> NDArray[np.float32]:
        """Return a layer (H, W), NaN where unknown; ValueError if there is none of this name."""
        return self._map.layer(name)

    def scan(self, T_map_base: NDArray) -> NDArray[np.float32]:
        """Return the values (P,) of the height scan."""
        return self._scan(T_map_base)[0]

    def statistics(self) -> dict[str, float]:
        """Return what the last update did."""
        return self._map.statistics()

    def diagnose(self) -> list[str]:
        """Return what looks wrong with the inputs."""
        return self._map.diagnose()

    def planes(self) -> list[Any]:
        """Refuse: the library finds no planes."""
        raise ValueError(_NEEDS_TORCH.format("planes"))

    def check_path(
        self, poses: NDArray[np.float64], footprint: NDArray[np.float64], T_map_base: NDArray[np.float64] | None
    ) -> PathAnswer:
        """Refuse: the library checks no paths."""
        raise ValueError(_NEEDS_TORCH.format("check_path"))

    def initialize_from(self, site: Path, T_map_base: NDArray[np.float64]) -> None:
        """Refuse: the library reads no site maps."""
        raise ValueError(_NEEDS_TORCH.format("initialize_from_site"))

    def reset(self) -> None:
        """Forget everything."""
        self._map.reset()

    def clear_around(self, center: NDArray[np.float64], radius: float) -> None:
        """Forget the cells within a radius [m] of a place (2,) [m]."""
        self._map.clear_around(center, radius)

    def initialize(self, feet: NDArray[np.float64], method: str, T_map_base: NDArray[np.float64]) -> None:
        """Estimate the unknown cells around the robot from ground points (K, 3) [m]."""
        self._map.move(T_map_base)
        self._map.initialize(feet, method)

    def save(self, path: Path) -> None:
        """Save the map."""
        self._map.save(path)

    def load(self, path: Path) -> None:
        """Load a map that was saved."""
        self._map.load(path)
