"""`torchelev plan`: find a path over a saved map, check it, and draw it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import click
import torch
from torch import Tensor

from torchelev.app.user_error import EmptyMapError, user_errors
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.io.export import load_map, take
from torchelev.pipeline import rate
from torchelev.planning.path_check import PathCheck, check_path
from torchelev.planning.planner import Path as PlannedPath
from torchelev.planning.planner import plan
from torchelev.planning.traversal_cost import TraversalCostConfig
from torchelev.robot import RobotConfig
from torchelev.traversability.heads import LearnedTraversabilityConfig, TraversabilityConfig

NO_PATH = 1  # exit code: there is no path, or it is not safe


def run_plan(
    map_file: Path,
    goal: tuple[float, float],
    start: tuple[float, float] | None,
    out: Path | None,
    robot: dict[str, float],
    class_costs: tuple[str, ...] = (),
) -> int:
    """Plan, check and report; bad input becomes a one-line click error.

    Args:
        map_file: of `torchelev map`, `save_npz` or `save_map`, of which the first environment counts.
        goal: x, y [m], map frame.
        start: x, y [m], map frame; None: the window's centre, where the robot was last.
        out: picture to write.
        robot: fields of `RobotConfig` that were given; without any, the map's own head rates the ground.
        class_costs: what classes of the map's channels cost, "channel.class=factor" each.

    Returns:
        The exit code.
    """
    with user_errors():
        if out is not None:
            _require_picture(out)
        costs = parse_class_costs(class_costs)
        emap = _load(map_file, robot)
        starts = emap.center[:, :2].double() if start is None else torch.tensor([start], dtype=torch.float64)
        goals = torch.tensor([goal], dtype=torch.float64)
        try:
            path, check = _plan(emap, starts, goals, _robot_of(emap, robot), costs)
        except KeyError as error:  # a channel or a class that is not there
            raise ValueError(error.args[0]) from error
        is_safe = bool(path.reached & check.safe)
        refused = None if is_safe else _refused_place(path, check)
        click.echo(_describe(starts, goal, path, check))
        if out is not None:
            _draw(emap, path, goal, refused, out)
            click.echo(f"wrote {out}")
    return 0 if is_safe else NO_PATH


def parse_class_costs(given: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Return the factors of "channel.class=factor" by channel and class.

    Raises:
        ValueError: a text has another form; the planner refuses factors out of range, and classes that are not there.
    """
    costs: dict[str, dict[str, float]] = {}
    for text in given:
        name, _, factor = text.partition("=")
        channel, _, part = name.partition(".")
        rule, hint = "must be CHANNEL.CLASS=FACTOR", "give semantic.mud=3, or semantic.water=inf"
        with suppress(ValueError):
            costs.setdefault(channel, {})[part] = float(factor)
        require(bool(channel and part) and part in costs.get(channel, {}), "--class-cost", rule, repr(text), hint)
    return costs


def _load(map_file: Path, robot: dict[str, float]) -> ElevationMap:
    """Read a map; rate its ground for a robot, if one is given."""
    emap = load_map(map_file, env_ids=[0])
    if not emap.state.validity.any():
        raise EmptyMapError(f"{map_file}: the map is empty; see what `torchelev map` said when it wrote it")
    if not robot and emap.cfg.traversability is not None:
        return emap
    head: TraversabilityConfig | LearnedTraversabilityConfig = TraversabilityConfig.of_robot(RobotConfig(**robot))
    if isinstance(emap.cfg.traversability, LearnedTraversabilityConfig):
        head = replace(emap.cfg.traversability, robot=RobotConfig(**robot))
    cfg = replace(emap.cfg, traversability=head)
    rated = ElevationMap(cfg, head=emap.head).to(emap.elevation.dtype)
    rated.load_state(rate(emap.state, cfg, None if rated.head is None else rated.head.weights))
    if rated.channels is not None and emap.channels is not None:
        rated.channels.load_state_dict(emap.channels.state_dict())
    return rated


def _robot_of(emap: ElevationMap, robot: dict[str, float]) -> RobotConfig:
    head = emap.cfg.traversability
    return (head.robot if head is not None else None) or RobotConfig(**robot)


def _plan(
    emap: ElevationMap, start: Tensor, goal: Tensor, robot: RobotConfig, class_costs: dict[str, dict[str, float]]
) -> tuple[PlannedPath, PathCheck]:
    """Plan for the robot's width or, where its footprint does not fit along the path, for all headings of its body.

    The learned head's ratings include the body, whose centre alone is checked.
    """
    length, width = (robot.length, robot.width) if emap.head is None else (2 * robot.foot_reach,) * 2
    corners = torch.tensor([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * torch.tensor([length / 2, width / 2])
    radius = math.hypot(length, width) / 2
    # Between two waypoints the robot moves by a cell's diagonal, and turns by less than a right angle.
    samples = math.ceil(2 + radius * math.pi / 2 / emap.cfg.grid.resolution)
    results = []
    for inflation in (width / 2, radius) if emap.head is None else (0.0,):
        path = plan(emap, start, goal, TraversalCostConfig(inflation_radius=inflation, class_costs=class_costs))
        results.append((path, check_path(emap, path.poses(), corners, samples=samples)))
        if results[-1][1].safe:
            return results[-1]
    return results[0]


def _describe(start: Tensor, goal: tuple[float, float], path: PlannedPath, check: PathCheck) -> str:
    """Return start, goal, and the path's length or the reason why there is none."""
    ends = f"from ({start[0, 0]:.2f}, {start[0, 1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f})"
    if not path.reached:
        return f"no path   {ends}: {path.explain()[0]}"
    kind = "path     " if check.safe else "not safe "
    return f"{kind} {ends}, {float(path.length):.2f} m, {int(path.count)} waypoints: {check.explain()[0]}"


def _require_picture(out: Path) -> None:
    """Refuse what no picture can be written to."""
    from torchelev.files.output_files import require_writable
    from torchelev.viz.style import require_picture

    require_picture(out)
    require_writable(out)


def _refused_place(path: PlannedPath, check: PathCheck) -> tuple[int, list[float]] | None:
    """Return the waypoint that cannot be reached safely, and x and y [m] of the first unsafe place.

    None where no path was found.
    """
    if check.safe or not torch.isfinite(path.cost):
        return None
    sample = int(check.footprints.safe[0].to(torch.uint8).argmin())
    return int(check.first_unsafe), check.poses[0, sample, :2].tolist()


def _draw(
    emap: ElevationMap,
    path: PlannedPath,
    goal: tuple[float, float],
    refused: tuple[int, list[float]] | None,
    out: Path,
) -> None:
    """Draw the path on elevation and traversability; from where it is refused on, dashed and in red."""
    from torchelev.viz.plot import Panel, draw_layers
    from torchelev.viz.style import write

    saved = take(emap, layers=("elevation", "traversability"))
    figure = draw_layers(
        [Panel(title=name, values=values) for name, values in saved.layers.items()], extent=saved.extent
    )
    xy = path.xy[0, : int(path.count)].numpy()
    end = len(xy) if refused is None else refused[0]
    for axes in figure.axes[: len(saved.layers)]:
        axes.plot(xy[:end, 0], xy[:end, 1], "k-", linewidth=1.5)
        axes.plot(*xy[0], "ko", markersize=5)
        axes.plot(*goal, "k*" if path.reached else "rX", markersize=9)
        if refused is not None:
            axes.plot(xy[max(end - 1, 0) :, 0], xy[max(end - 1, 0) :, 1], "r--", linewidth=1.5)
            axes.plot(*refused[1], "rX", markersize=9, label="not safe: the body does not fit here")
            axes.legend(loc="lower left")
    write(figure, out)
