"""The scenes of the accuracy and feature tables, by Python and by the C library: each tensor after each update."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast
from unittest.mock import patch

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.quality.accuracy.__main__ import cases
from benchmarks.quality.accuracy.score import score
from benchmarks.quality.features.comparison import FEATURES, examine
from benchmarks.runtime.build import machine
from torchelev import ElevationMap, HeightScan
from torchelev.errors import require
from torchelev.files.config_files import to_json
from torchelev.maps.buffers import name_tensors
from torchelev.runtime.library import CMap, build_library


class Twins:
    """The C library's twin of each map that is updated, and what differed."""

    def __init__(self) -> None:
        self.library, self.scan = build_library(), HeightScan.isaac_lab()
        self.maps: dict[int, tuple[ElevationMap, CMap, Any]] = {}
        self.updates = self.differing = self.scans = self.differing_scans = 0

    def update(self, emap: ElevationMap, points: Tensor, T_map_sensor: Tensor, T_map_base: Any, dt: float) -> None:
        """Update a map's twin, and compare."""
        require(emap.backend.name == "CPU", "backend", "must be CPU", emap.backend, "install g++")
        if id(emap) not in self.maps:
            twin = CMap(self.library, json.dumps(to_json(emap.cfg.to_dict())), max_points=points.shape[-2])
            self.maps[id(emap)] = emap, twin, twin.scan("isaac_lab")  # the map, too, so that no other has its number
        _, twin, scan = self.maps[id(emap)]
        base = None if T_map_base is None else T_map_base[0].double()
        twin.update(points.float().numpy(), T_map_sensor.double().numpy(), base, dt)
        wanted = {name: value[0].numpy() for name, value in name_tensors(emap.state).items()}
        self.updates += 1
        self.differing += any(twin.tensor(k, v.dtype).tobytes() != v.tobytes() for k, v in wanted.items())
        if base is not None:
            self.scans += 1
            values, known = self.scan(emap, T_map_base.double())
            mine, mine_known = scan(base)
            same = mine.tobytes() == values[0].numpy().tobytes() and (mine_known == known[0].numpy()).all()
            self.differing_scans += not same


@contextmanager
def twins() -> Iterator[Twins]:
    """Compare all updates of maps while this lasts."""
    found, update = Twins(), cast(Any, ElevationMap.update)

    def both(emap: ElevationMap, points: Tensor, T_map_sensor: Tensor, T_map_base: Any = None, dt: Any = None) -> None:
        update(emap, points, T_map_sensor, T_map_base, dt)
        found.update(emap, points, T_map_sensor, T_map_base, dt)

    with patch.object(ElevationMap, "update", both):
        yield found


def replay() -> dict[str, Any]:
    """Map all scenes by both; return how many updates and scans there were, and how many differ."""
    rows = {}
    torch.set_num_threads(2)
    for feature in tqdm(FEATURES, desc="features"):
        with twins() as found:
            examine(feature)
        rows[f"feature, {feature.name}"] = _row(found)
    for motion in ("turn", "walk", "lidar"):
        with twins() as found:
            for case in tqdm([case for case in cases() if case[1] == motion], desc=f"accuracy, {motion}"):
                score(*case)
        rows[f"accuracy, {motion}"] = _row(found)
    return {**machine(), "rows": rows}


def _row(found: Twins) -> dict[str, int]:
    return {
        **{"maps": len(found.maps), "updates": found.updates, "updates that differ": found.differing},
        **{"scans": found.scans, "scans that differ": found.differing_scans},
    }
