"""Refine a path by gradient descent through the traversability that its segments cross."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchelev import ElevationMap
from torchelev.planning.planner import plan
from torchelev.sim import Lidar
from torchelev.sim.exact.scenes import boxes
from torchelev.sim.poses import pose

_GOALS = ((-1.0, 3.5), (-2.0, 2.0), (1.5, 3.5), (-3.0, 3.0))  # [m] between boxes


def refine(emap: ElevationMap, xy: Tensor, steps: int = 100, rate: float = 0.01) -> Tensor:
    """Move waypoints down the gradient of the path's cost.

    Minimizes the sum of the squares of `piece_costs`, which is smallest where the costs are low and equal, so that no
    segment grows until it skips bad ground.

    Args:
        emap: the map with the traversability.
        xy: waypoints (B, M, 2) [m], map frame; the first and the last stay.
        steps: number of gradient steps.
        rate: learning rate of Adam [m].

    Returns:
        The refined waypoints (B, M, 2) [m].
    """
    inner = xy[:, 1:-1].clone().requires_grad_()
    optimizer = torch.optim.Adam([inner], lr=rate)
    for _ in range(steps):
        optimizer.zero_grad()
        piece_costs(emap, torch.cat([xy[:, :1], inner, xy[:, -1:]], 1)).square().sum().backward()
        optimizer.step()
    return torch.cat([xy[:, :1], inner.detach(), xy[:, -1:]], 1)


def piece_costs(emap: ElevationMap, xy: Tensor, samples: int = 8, doubt: float = 1.0) -> Tensor:
    """Return the cost (B, M - 1) of the straight segments between waypoints (B, M, 2) [m], differentiable.

    A segment's cost is its length times the mean, over `samples` points on it, of 1 + 4 (1 - t) + doubt (1 - v), with
    the traversability t, 1 where unknown, and the interpolated validity v.
    """
    fraction = (torch.arange(samples, dtype=xy.dtype) + 0.5)[:, None] / samples
    piece = xy[:, 1:] - xy[:, :-1]
    places = (xy[:, :-1, None] + fraction * piece[:, :, None]).flatten(1, 2)
    (t, known), (v, _) = (emap.sample(places, layer) for layer in ("traversability", "validity"))
    cost = 1 + 4 * (1 - torch.where(known, t, 1.0)) + doubt * (1 - v)
    return piece.norm(dim=-1) * cost.unflatten(1, (-1, samples)).mean(-1)


def refined_costs(number: int = 24) -> list[dict[str, Any]]:
    """Refine planned paths between boxes; return their costs before and after [m of easy ground]."""
    emap, scene, lidar = ElevationMap(), boxes(), Lidar(rings=96, fov_low_deg=-75.0)
    for y in (0.0, 1.5, 3.0):
        T = pose(torch.tensor([[0.0, y, 1.0]], dtype=torch.float64), torch.zeros(1))
        emap.update(lidar.cast(scene, T[0])[None], T, dt=0.0)
    rows: list[dict[str, Any]] = []
    for goal in _GOALS:
        path = plan(emap, torch.zeros(1, 2), torch.tensor([goal]))
        last = int(path.count[0]) - 1
        planned = path.xy[:, torch.linspace(0, last, number).round().long()]
        paths = {"planned": planned, "refined": refine(emap, planned)}
        costs = {name: round(float(piece_costs(emap, xy, samples=50).sum()), 3) for name, xy in paths.items()}
        rows.append({"goal": goal} | costs)
    return rows
