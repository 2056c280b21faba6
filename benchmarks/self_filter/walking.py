"""How right the self-filter is while the quadruped of envs/ walks, with errors of its sensors and joint encoders."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from envs.quadruped import Quadruped, QuadrupedConfig
from envs.quadruped.sight import MapSight, Seen
from torchelev.app.results import markdown_table
from torchelev.robot_body.own_points import find_own_points
from torchelev.robot_body.posing import pose_body, relative_pose

ROBOTS = 64
_ARTEFACT = 0.05  # [m] error of a depth beyond which a point is an artefact in the air, on nothing
_MOUNTINGS = {"calibrated to 1 mm and 0.1 degrees": (0.001, 0.1), "to 5 mm and 0.5 degrees": (0.005, 0.5)}
NEAR = 0.05  # [m] from the middle of a foot, horizontally: ground near it
_SETTLE = 20  # steps before the first scan that counts


def count_points(task: Quadruped, seen: Seen) -> Counter[str]:
    """Count points on the robot, and ground points near its feet, and how many of each the filter takes for the robot.

    The rays hit the robot or the ground as simulated; the filter knows only points and joint encoders, with errors.
    """
    sight, view = task.sight, task.view()
    assert isinstance(sight, MapSight)
    taken = own_points(sight, seen, view.T_estimated, view.T_base_links_measured[:, sight.link_ids])
    returned = torch.isfinite(seen.points).all(-1)
    in_map = seen.points @ seen.T_map_sensor[..., :3, :3].mT + seen.T_map_sensor[..., None, :3, 3]
    feet = view.feet_in(view.T_estimated)
    distance = torch.cdist(in_map[..., :2].flatten(1, 2), feet[..., :2]).amin(-1).view_as(taken)
    near = returned & ~seen.on_body & (distance < NEAR)
    error = (seen.points - seen.ideal).norm(dim=-1)
    own, artefact = (returned & seen.on_body & chosen for chosen in (error <= _ARTEFACT, error > _ARTEFACT))
    sizes = {"own": own, "own_taken": own & taken, "near": near, "near_taken": near & taken, "artefacts": artefact}
    return Counter({name: int(chosen.sum()) for name, chosen in sizes.items()})


def own_points(sight: MapSight, seen: Seen, T_map_base: Tensor, T_base_links: Tensor) -> Tensor:
    """Return which points (B, S, N) the map's self-filter takes for the robot's own."""
    posed = pose_body(sight.body, relative_pose(seen.T_map_sensor, T_map_base, torch.float32), T_base_links)
    points = seen.points.nan_to_num(1e3)
    x, y, z = points.unbind(-1)
    return find_own_points(x, y, z, points.square().sum(-1), posed, sight.body)


def measure(seconds: float, robots: int = ROBOTS) -> dict[str, Any]:
    """Measure with cameras that are calibrated well and badly, for a time [s] of the simulation each."""
    rows = {name: _walk(_config(error), seconds, robots) for name, error in _MOUNTINGS.items()}
    return {"robots": robots, "near": NEAR, "seconds": seconds, "rows": rows}


def _config(mounting_error: tuple[float, float]) -> QuadrupedConfig:
    cfg = QuadrupedConfig()
    return dataclasses.replace(cfg, sight=dataclasses.replace(cfg.sight, mounting_error=mounting_error))


@torch.inference_mode()
def _walk(cfg: QuadrupedConfig, seconds: float, robots: int) -> dict[str, float]:
    """Let the robots trot over all kinds of terrain, and count."""
    task = Quadruped(cfg, robots, perception="map")
    assert isinstance(task.sight, MapSight)
    counts: Counter[str] = Counter()
    still = torch.zeros(robots, task.num_actions)
    for step in tqdm(range(round(seconds / task.cfg.dt)), unit="step", leave=False):
        task.reset(task.advance(still).done)
        if step >= _SETTLE and step % task.cfg.sight.map_every == 0:
            counts += count_points(task, task.sight.look(task.view()))
    figures = {"removed": counts["own_taken"] / counts["own"], "ground_lost": counts["near_taken"] / counts["near"]}
    return {**counts, **figures}


def table(result: dict[str, Any]) -> str:
    """Tabulate how much of the robot is removed, and of the ground near its feet lost."""
    head = [
        "cameras",
        "points on the robot",
        "removed",
        f"ground points within {100 * result['near']:g} cm of feet",
        "lost",
    ]
    rows = [
        [name, f"{row['own']:,}", f"{row['removed']:.2%}", f"{row['near']:,}", f"{row['ground_lost']:.2%}"]
        for name, row in result["rows"].items()
    ]
    return markdown_table(head, rows)
