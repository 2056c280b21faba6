"""`torchelev plan`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import click

from torchelev.robot import RobotConfig

_PLAN_HELP = """Find a path over a saved map, and check the robot's footprint along it.

MAP is an .npz of `torchelev map`, `save_npz` or `save_map`. With a limit or a
size of the robot, the ground is rated for this robot; without any, by the
traversability head of the map, whose limits hold.

\b
  torchelev plan map.npz --goal 3.5 1.0
  torchelev plan map.npz --goal 3.5 1.0 --step-height 0.16 --out path.png

Exit code 0: a safe path; 1: none, with the reason; 2: bad input; 3: the map is
empty.
"""


def _robot_option(name: str, unit: str, text: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    default = {field.name: field.default for field in fields(RobotConfig)}[name.replace("-", "_")]
    return click.option(f"--{name}", type=float, metavar=unit, help=f"{text}  [default with another: {default}]")


@click.command("plan", help=_PLAN_HELP, short_help="Find a path over a saved map.")
@click.argument("map_file", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--goal", type=float, nargs=2, metavar="X Y", required=True, help="Where to go [m], map frame.")
@click.option("--start", type=float, nargs=2, metavar="X Y", help="Where from [m].  [default: the map's centre]")
@click.option("--out", type=click.Path(path_type=Path), metavar="PICTURE", help="Picture to write: .png or .svg.")
@click.option(
    "--class-cost",
    "class_costs",
    multiple=True,
    metavar="CLASS=FACTOR",
    help="What a metre on a class costs, such as semantic.mud=3, or semantic.water=inf to forbid it; repeat it.",
)
@_robot_option("step-height", "M", "Highest step of the robot [m].")
@_robot_option("max-slope", "RAD", "Its steepest slope [rad].")
@_robot_option("clearance", "M", "Height of its belly over its feet [m].")
@_robot_option("length", "M", "From its front to its hind feet [m].")
@_robot_option("width", "M", "From its left to its right feet [m].")
def plan_command(
    map_file: Path,
    goal: tuple[float, float],
    start: tuple[float, float] | None,
    out: Path | None,
    class_costs: tuple[str, ...],
    **robot: float | None,
) -> None:
    """Run `torchelev plan`; its help text is `_PLAN_HELP`."""
    from torchelev.app.plan_command import run_plan

    given = {name: value for name, value in robot.items() if value is not None}
    sys.exit(run_plan(map_file, goal, start, out, given, class_costs))
