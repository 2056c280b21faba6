"""A safe occlusion, or a drop? `python -m benchmarks.quality.occlusion`

A robot walks up to ground that it cannot see: behind a hump, below a brow or a low step, where it goes on, or in a
trench and below cliffs, where it does not. Four rules for unknown ground plan a way to a goal beyond, over the same
maps and with the same planner: the upper bound's inclination (`traversal_cost`), two ways of in-painting, and none,
which takes it for impassable. Counts who is right, by distance and over the whole walk, and draws one safe occlusion
and two drops, into benchmarks/results/occlusion.json and .png.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path as File
from typing import Any

import click
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.quality.occlusion_picture import draw
from benchmarks.quality.occlusion_scenes import GRID, KINDS, VIEWS, views
from torchelev import ElevationMap, filters
from torchelev.app.results import markdown_table, write_json
from torchelev.pipeline import rate_surface
from torchelev.planning.planner import Path, plan
from torchelev.planning.traversal_cost import TraversalCostConfig
from torchelev.sim import Lidar
from torchelev.sim.exact.scenes import boxes
from torchelev.sim.poses import pose
from torchelev.state import MapState

RESULTS = File(__file__).parents[1] / "results"
PESSIMIST = TraversalCostConfig(cross_unknown=False)
RULES = ("upper bound", "in-painted by diffusion", "in-painted by the minimum", "unknown is impassable")
SHOWN = (("hump", 0.8), ("cliff", 0.4), ("abyss", 0.5))  # kind, and how large within its range
SHOWN_AT = 1.2  # [m] before the edge
GOALS = ((-1.0, 3.5), (-2.0, 2.0), (1.5, 3.5), (-3.0, 3.0))  # [m] between crates

Rows = list[dict[str, Any]]


def inpainted(emap: ElevationMap, filter_name: str) -> MapState:
    """Return the state with all unknown ground in-painted, and rated as if it had been seen."""
    layer = (emap.state.elevation, emap.state.validity)
    elevation, known = filters.Filter(filter_name)(layer, resolution=GRID.resolution)
    return rate_surface(emap.state._replace(elevation=elevation, validity=known), emap.cfg)


def decide(emap: ElevationMap, x: float, goal: float) -> dict[str, Path]:
    """Plan by each rule from (x, 0) to (goal, 0) [m]."""
    places = torch.tensor([[x, 0.0]]), torch.tensor([[goal, 0.0]])
    plans = (
        plan(emap, *places),
        plan(emap, *places, state=inpainted(emap, "inpaint_diffusion")),
        plan(emap, *places, state=inpainted(emap, "inpaint_minimum")),
        plan(emap, *places, PESSIMIST),
    )
    return dict(zip(RULES, plans, strict=True))


def trials(each: int, seed: int) -> Iterator[Rows]:
    """Yield, for each of `each` random scenes of each kind, what every rule decides at every view."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(each):
        for make in KINDS:
            case = make(torch.rand(2, generator=generator, dtype=torch.float64).tolist())
            rows = []
            for view, (emap, x) in views(case, generator).items():
                for rule, path in decide(emap, x, case.goal).items():
                    goes = bool(path.reached[0])
                    rows.append({"kind": case.kind, "safe": case.safe, "view": view, "rule": rule, "goes": goes})
            yield rows


def summary(scenes: list[Rows]) -> dict[str, Any]:
    """Return the shares of scenes in which each rule is right [%]: it goes on where that is safe, or does not.

    By kind and distance; and over whole walks, where it is right if it finds a way at every view, or stops at one.
    """
    result: dict[str, Any] = {}
    for rule in RULES:
        for kind in dict.fromkeys(rows[0]["kind"] for rows in scenes):
            walks = [[row for row in rows if row["rule"] == rule] for rows in scenes if rows[0]["kind"] == kind]
            shares = {f"{v} m": _share([row["goes"] == row["safe"] for w in walks for row in w if row["view"] == v])
                      for v in VIEWS}  # fmt: skip
            whole = _share([all(row["goes"] for row in walk) == walk[0]["safe"] for walk in walks])
            result.setdefault(rule, {})[kind] = shares | {"whole walk": whole}
    return result


def _share(right: list[bool]) -> float:
    return round(100 * sum(right) / len(right), 1)


def table(right: dict[str, Any]) -> str:
    """Tabulate the summary."""
    rows = [
        [rule, kind, *(f"{share:.0f}" for share in shares.values())]
        for rule, kinds in right.items()
        for kind, shares in kinds.items()
    ]
    return markdown_table(["rule", "ground", *(f"{v} m" for v in VIEWS), "whole walk"], rows)


# Descending through the rating ----------------------------------------------------------------------------------------


def refine(emap: ElevationMap, xy: Tensor, steps: int = 100, rate: float = 0.01) -> Tensor:
    """Return waypoints (B, M, 2) [m], map frame, moved downhill along the gradient of what their way costs.

    The sum of the squares of `piece_costs` is made small: it is least where their sum is and all are alike, so that no
    piece grows until it leaps over bad ground. The ends stay.
    """
    inner = xy[:, 1:-1].clone().requires_grad_()
    optimizer = torch.optim.Adam([inner], lr=rate)
    for _ in range(steps):
        optimizer.zero_grad()
        piece_costs(emap, torch.cat([xy[:, :1], inner, xy[:, -1:]], 1)).square().sum().backward()
        optimizer.step()
    return torch.cat([xy[:, :1], inner.detach(), xy[:, -1:]], 1)


def piece_costs(emap: ElevationMap, xy: Tensor, samples: int = 8, doubt: float = 1.0) -> Tensor:
    """Return what the straight pieces between waypoints (B, M, 2) cost (B, M - 1), differentiable.

    Their length times the mean, over `samples` places along them, of 1 + 4 (1 - t) + doubt (1 - v), with the
    traversability t, 1 where it is not known, and the share v of known ground between the cells around.
    """
    share = (torch.arange(samples, dtype=xy.dtype) + 0.5)[:, None] / samples
    piece = xy[:, 1:] - xy[:, :-1]
    places = (xy[:, :-1, None] + share * piece[:, :, None]).flatten(1, 2)
    (t, known), (v, _) = (emap.sample(places, layer) for layer in ("traversability", "validity"))
    cost = 1 + 4 * (1 - torch.where(known, t, 1.0)) + doubt * (1 - v)
    return piece.norm(dim=-1) * cost.unflatten(1, (-1, samples)).mean(-1)


def refined(number: int = 24) -> Rows:
    """Refine ways between crates, and return what they cost before and after [m of easy ground]."""
    emap, scene, lidar = ElevationMap(), boxes(), Lidar(rings=96, fov_low_deg=-75.0)
    for y in (0.0, 1.5, 3.0):
        T = pose(torch.tensor([[0.0, y, 1.0]], dtype=torch.float64), torch.zeros(1))
        emap.update(lidar.cast(scene, T[0])[None], T, dt=0.0)
    rows = []
    for goal in GOALS:
        way = plan(emap, torch.zeros(1, 2), torch.tensor([goal]))
        last = int(way.count[0]) - 1
        before = way.xy[:, torch.linspace(0, last, number).round().long()]
        ways = {"planned": before, "refined": refine(emap, before)}
        costs = {name: round(float(piece_costs(emap, xy, samples=50).sum()), 3) for name, xy in ways.items()}
        rows.append({"goal": goal} | costs)
    return rows


def shown(kind: str, size: float) -> tuple[Any, ElevationMap, float]:
    """Return a scene of the picture, its map and where the robot is [m]."""
    (make,) = (make for make in KINDS if make.__name__ == kind)
    case = make([size, size])
    return case, *views(case, torch.Generator().manual_seed(0))[SHOWN_AT]


@click.command()
@click.option("--each", default=12, show_default=True, help="Random scenes of each kind.")
@click.option("--seed", default=0, show_default=True)
def main(each: int, seed: int) -> None:
    """Count how often each rule tells a safe occlusion from a drop, and draw three scenes."""
    scenes = list(tqdm(trials(each, seed), total=each * len(KINDS), unit="scene"))
    right = summary(scenes)
    values = {"each": each, "seed": seed, "right [%]": right, "cost of ways between crates [m]": refined()}
    write_json(RESULTS / "occlusion.json", values)
    pictures = [(*found, decide(found[1], found[2], found[0].goal)) for found in (shown(*which) for which in SHOWN)]
    draw(RESULTS / "occlusion.png", pictures)
    click.echo(table(right))
    click.echo(values["cost of ways between crates [m]"])


if __name__ == "__main__":
    main()
