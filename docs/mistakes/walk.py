"""The simulated walk that mistakes are made on, and the map of it."""

from __future__ import annotations

import functools
from typing import NamedTuple

from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig
from torchelev.sim import DepthCamera, mount, walk
from torchelev.sim.exact import scenes

DT = 0.2  # [s]
CAMERA = DepthCamera(width=120, height=90, max_range=5.0)


class Scan(NamedTuple):
    """The arguments of `ElevationMap.update` for one robot."""

    points: Tensor  #: (1, N, 3) [m] sensor frame: x forward, y left, z up
    T_map_sensor: Tensor  #: (1, 4, 4)
    T_map_base: Tensor | None  #: (1, 4, 4)
    dt: float  #: [s]


@functools.cache
def scans_of(scene: str, pitch_deg: float) -> list[Scan]:
    """Simulate the walk over a scene: ahead for 3 m, and a turn to the right."""
    world = getattr(scenes, scene)()
    route = [(-2.6, 0.05), (0.6, 0.05), (0.6, -0.6)]
    path = walk(world, route, dt=DT, T_base_sensor=mount(pitch_deg))
    poses = zip(path.T_map_sensor, path.T_map_base, path.times.tolist(), strict=True)
    return [Scan(CAMERA.cast(world, T, t)[None], T[None], base[None], DT) for T, base, t in poses]


def map_of(scans: list[Scan], cfg: ElevationMapConfig) -> ElevationMap:
    """Return the map of some scans."""
    emap = ElevationMap(cfg)
    for points, T_map_sensor, T_map_base, dt in scans:
        emap.update(points, T_map_sensor, T_map_base, dt=dt)
    return emap
