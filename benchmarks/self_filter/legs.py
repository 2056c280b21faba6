"""Which points on the legs the self-filter leaves, and how much of the ground around the feet it takes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from benchmarks.self_filter.robot import FOOT_RADIUS, Scan, make_body, make_cameras, walk
from torchelev import ElevationMap, ElevationMapConfig, RobotBody, SensorConfig

NEAR = 0.05  # [m] between a foot's surface and the ground that counts as near
PADDINGS = (0.0, 0.003, 0.005, 0.01)  # [m]
NOISES = (0.0, 0.003, 0.006)  # [m] sigma of the depth; the default noise model has 6 mm at 0.3 m


def _distance_to_feet(scan: Scan, body: RobotBody) -> Tensor:
    """Return the distance of points (B, S, N) from the surface of the nearest foot [m]."""
    to_map = scan.T_map_sensor
    points = scan.points.double() @ to_map[..., :3, :3].mT + to_map[..., None, :3, 3]
    distances = []
    for foot in (capsule for capsule in body.capsules if not capsule.length):
        T = scan.T_map_base @ scan.T_base_links[:, body.links.index(foot.link)]
        center = T @ torch.tensor([*foot.start, 1.0], dtype=torch.float64)
        distances.append((points - center[:, None, None, :3]).norm(dim=-1) - FOOT_RADIUS)
    return torch.stack(distances).amin(0)


def _is_own(scan: Scan, body: RobotBody, noise: float) -> Tensor:
    """Return which points (B, S, N) a map counts as the robot's own, when their depth has this noise."""
    generator = torch.Generator().manual_seed(0)
    distance = scan.points.norm(dim=-1, keepdim=True)
    points = scan.points * (1 + noise * torch.randn(distance.shape, generator=generator) / distance)
    emap = ElevationMap(ElevationMapConfig(sensor=SensorConfig(min_distance=0.0, body=body)), len(points))
    m = emap.measure(points, scan.T_map_sensor, scan.T_map_base, 0.1, T_base_links=scan.T_base_links)
    return ~m.casts.view(points.shape[:3]) & points.isfinite().all(-1)


def measure(robots: int = 32, width: int = 80, height: int = 60) -> dict[str, Any]:
    """Return the shares of points on the body that are left, and of ground near the feet that is lost, by row."""
    (scan,) = walk(robots, 1, make_cameras(width, height))
    is_seen = scan.points.isfinite().all(-1)
    on_body = is_seen & scan.on_body
    near_feet = is_seen & ~scan.on_body & (_distance_to_feet(scan, make_body()) < NEAR)
    rows = {}
    for noise in NOISES:
        for padding in PADDINGS:
            own = _is_own(scan, make_body(padding=padding), noise)
            left, lost = 1 - own[on_body].double().mean(), own[near_feet].double().mean()
            rows[f"{1e3 * padding:g} mm, {1e3 * noise:g} mm"] = {"left": float(left), "lost": float(lost)}
    return {"on_body": int(on_body.sum()), "near_feet": int(near_feet.sum()), "rows": rows}
