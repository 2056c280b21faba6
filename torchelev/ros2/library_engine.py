"""A node's map by the C library, without PyTorch."""

from __future__ import annotations

import ctypes.util
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.config_files import to_json
from torchelev.errors import require
from torchelev.ros2.engine import Window
from torchelev.ros2.settings import NodeSettings


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
        self._scan = self._map.scan(settings.height_scan)

    def update(self, points: NDArray, T_map_sensor: NDArray, T_map_base: NDArray, dt: float) -> None:
        """Fuse points (N, 3) of one sensor."""
        self._map.update(points[None], T_map_sensor[None], T_map_base, dt)

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

    def reset(self) -> None:
        """Forget everything."""
        self._map.reset()

    def save(self, path: Path) -> None:
        """Save the map."""
        self._map.save(path)

    def load(self, path: Path) -> None:
        """Load a map that was saved."""
        self._map.load(path)
