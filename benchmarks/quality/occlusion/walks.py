"""The maps of a robot that walks up to an edge at x = 0."""

from __future__ import annotations

import torch

from benchmarks.quality.occlusion.scenes import Case
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, RobotConfig, TraversabilityConfig
from torchelev.sim import DepthCamera, mount, noisy, walk

GRID = GridConfig(resolution=0.04, length_x=12.0, length_y=4.0)
CONFIG = ElevationMapConfig(grid=GRID, traversability=TraversabilityConfig.of_robot(RobotConfig()))
CAMERA, T_BASE_CAMERA = DepthCamera(max_range=8.0), mount(pitch_deg=30.0)
DT, SPEED = 0.2, 0.5  # [s], [m/s]
FROM, TO = -2.8, -0.6  # [m] of the walk along x
VIEWS = (2.4, 2.0, 1.6, 1.2, 0.8)  # [m] distances from the edge at which the map is used


def views(case: Case, generator: torch.Generator) -> dict[float, tuple[ElevationMap, float]]:
    """Walk up to the edge; return a copy of the map and the robot's x [m] at each of VIEWS."""
    emap, shots = ElevationMap(CONFIG), {}
    path = walk(case.scene, [(FROM, 0.0), (TO, 0.0)], speed=SPEED, dt=DT, T_base_sensor=T_BASE_CAMERA)
    for T_base, T_sensor, t in zip(*path, strict=True):
        seen = CAMERA.cast(case.seen or case.scene, T_sensor, float(t))
        if case.disturb is not None:
            R, origin = T_sensor[:3, :3].to(seen.dtype), T_sensor[:3, 3].to(seen.dtype)
            seen = (case.disturb(seen @ R.T + origin, origin, generator) - origin) @ R
        emap.update(noisy(seen, generator)[None], T_sensor[None], T_base[None], DT)
        x = float(T_base[0, 3])
        view = next((v for v in VIEWS if abs(x + v) < SPEED * DT / 2), None)
        if view is not None:
            shots[view] = (_copy(emap), x)
    return shots


def _copy(emap: ElevationMap) -> ElevationMap:
    copy = ElevationMap(emap.cfg)
    copy.load_state_dict(emap.state_dict())
    return copy
