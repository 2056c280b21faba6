"""The command line: commands, options and help texts. Each command's work is done in a module of its own."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from torchelev import __version__
from torchelev.app.mapping.map_help import MAP_HELP
from torchelev.app.mapping.map_options import map_options
from torchelev.app.mapping.map_request import MapRequest
from torchelev.app.option_groups import GroupedCommand, GroupedOption
from torchelev.app.ros2_command import ros2_command
from torchelev.app.site.commands import site_command
from torchelev.app.user_error import plain_warnings, user_errors
from torchelev.robot import RobotConfig


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__)
def main() -> None:
    """Build elevation maps from point clouds and depth images."""
    click.get_current_context().with_resource(plain_warnings())


@main.command(
    "map", cls=GroupedCommand, help=MAP_HELP, short_help="Build an elevation map from scans with poses, or a bag."
)
@map_options
def map_command(**options: Any) -> None:
    """Run `torchelev map`; its help text is `MAP_HELP`."""
    from torchelev.app.mapping.map_command import run_map

    sys.exit(run_map(MapRequest(**options)))


@main.command("bag", short_help="List what a bag holds, and how to map it.")
@click.argument("bag", type=click.Path(path_type=Path))
def bag_command(bag: Path) -> None:
    """List topics, types, counts, rates and frames of BAG and its tree of transforms; propose the command to map it."""
    from torchelev.app.bag_command import describe_bag

    with user_errors():
        click.echo(describe_bag(bag))


@main.command("demo", short_help="Map a simulated walk and compare it with ground truth.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("demo.png"), show_default=True, help="Picture to write."
)
@click.option("--seconds", type=float, metavar="S", help="Simulated time to walk [s].  [default: the whole course]")
@click.option(
    "--record", "bag", type=click.Path(path_type=Path), metavar="BAG",
    help="Write the walk to this bag instead, such as drive.mcap: a recording for the other commands.",
)  # fmt: skip
@click.option("--quiet", is_flag=True, help="Hide the progress bar.")
def demo_command(out: Path, seconds: float | None, bag: Path | None, quiet: bool) -> None:
    """Map a simulated walk with a depth camera and compare the map with the ground truth."""
    with user_errors():
        if bag is not None:
            from torchelev.app.demo_recording import record_demo

            click.echo(f"wrote {record_demo(bag, seconds, not quiet)} depth images and their poses to {bag}")
            return
        from torchelev.app.demo import run_demo

        click.echo(run_demo(out=out, seconds=seconds, progress=not quiet))
    click.echo(f"wrote {out}")


_FLEET_HELP = """Let simulated robots explore a terrain together; merge what they see into one map.

All robots share one batched ElevationMap. Each of them walks to the frontiers
of what is known, around what is too steep, and has its own error of height,
up to 15 cm, which also drifts. Once a second their maps become part of a site
map, which finds these offsets from the ground that they have in common.

\b
  torchelev fleet                                 16 robots, 60 x 60 m
  torchelev fleet --robots 4 --size 30 --seed 7
  torchelev fleet --site hill/                    keep the map, go on later
  torchelev fleet --live                          watch it grow in the browser

With --service, each robot sends its map over the network of this machine to
a merger in a process of its own, as of `torchelev site serve`, and what is
shown and planned is what comes back.

The mission ends when nothing is left to explore, or after --seconds. Ctrl-C
ends it earlier and keeps what was mapped.

\b
Output files:
  fleet.png   ground truth, site map, its error, and the robots' paths
  fleet.json  the numbers, with those of each robot and of each merge
"""


@main.command("fleet", help=_FLEET_HELP, short_help="Map a simulated site with many robots at once.")
@click.option("--robots", type=int, default=16, show_default=True, metavar="N", help="Number of robots.")
@click.option("--size", type=float, default=60.0, show_default=True, metavar="M", help="Side of the square area [m].")
@click.option("--resolution", type=float, default=0.1, show_default=True, metavar="M", help="Cell size [m].")
@click.option(
    "--seconds", type=float, default=120.0, show_default=True, metavar="S", help="Simulated time at most [s]."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the terrain and of all errors.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("fleet.png"),
    show_default=True,
    help="Picture to write; the numbers lie beside it as .json.",
)
@click.option(
    "--site",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Keep the site map there. One that is there is continued: give the same --seed, --size and --resolution. "
    "Needs torchelev[site].  [default: a temporary folder]",
)
@click.option("--live", is_flag=True, help="Show the growing map in the browser; needs torchelev[view].")
@click.option(
    "--service/--no-service",
    default=None,
    help="Merge in another process, over Zenoh; needs torchelev[serve].  [default: with --live, if that is installed]",
)
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address of --live; 0.0.0.0 lets other machines connect."
)
@click.option("--port", type=click.IntRange(1, 65535), default=8080, show_default=True, help="Port of --live.")
@click.option("--quiet", is_flag=True, help="Hide the progress bar.")
def fleet_command(quiet: bool, **options: Any) -> None:
    """Run `torchelev fleet`; its help text is `_FLEET_HELP`."""
    from torchelev.app.fleet.command import run_fleet
    from torchelev.app.fleet.request import FleetRequest

    with user_errors():
        request = FleetRequest(**options)
    sys.exit(run_fleet(request, quiet))


_VIEW_HELP = """Show a map in the browser while it grows.

RECORDING is a folder of scans or a bag, as of `torchelev map`, with the same
options; or a map that was saved, .npz. Without it, a simulated walk is shown.

\b
  torchelev view                   the demo's walk
  torchelev view drive.mcap        a bag
  torchelev view drive/            a folder of scans with poses
  torchelev view map.npz           a saved map

The page plays the recording, pauses, steps and goes back. It colours the
surface by any layer, shows cloud, frames, path and planes, and the values of
the cell that is clicked. Ctrl-C closes it.
"""


def _view_command(recording: Path | None, host: str, port: int, paused: bool, **options: Any) -> None:
    """Run `torchelev view`; its help text is `_VIEW_HELP`."""
    from torchelev.app.view_command import run_view

    request = None if recording is None else MapRequest(recording=recording, **options)
    run_view(request, host, port, paused)


_OUTPUTS = ("recording", "out", "grid_map", "video", "every")  # parameters of `map` that `view` lacks
_PAGE = "Page"
_VIEW_OPTIONS: list[click.Parameter] = [
    click.Argument(["recording"], type=click.Path(path_type=Path), required=False),
    GroupedOption(
        ["--host"],
        group=_PAGE,
        default="127.0.0.1",
        show_default=True,
        help="Address of the page; 0.0.0.0 lets other machines connect.",
    ),
    GroupedOption(
        ["--port"],
        group=_PAGE,
        type=click.IntRange(1, 65535),
        default=8080,
        show_default=True,
        help="Port of the page.",
    ),
    GroupedOption(["--paused"], group=_PAGE, is_flag=True, help="Wait at the first scan."),
    *(parameter for parameter in map_command.params if parameter.name not in _OUTPUTS),
]
main.add_command(
    GroupedCommand(
        "view", params=_VIEW_OPTIONS, callback=_view_command, help=_VIEW_HELP, short_help="Show a map in the browser."
    )
)


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


@main.command("plan", help=_PLAN_HELP, short_help="Find a path over a saved map.")
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


@main.command("filters", short_help="List the filters that a config can use.")
def filters_command() -> None:
    """List the filters that a config can use, with their inputs and settings."""
    from torchelev.filters.registry import listing

    click.echo(listing())


_EXPORT_HELP = """Bundle what a policy needs on a robot.

RUN is the folder of a training: policy.onnx, and the map's config, the
observation groups and an episode, which `python -m training.nav`, `python -m
training.quadruped` and `torchelev.runtime.bundle.recording.Recorder` write.

\b
  torchelev export runs/nav --out bundle
  torchelev check bundle

The bundle holds them with hashes and versions. Parts that do not fit each
other are refused by name.
"""


@main.command("export", help=_EXPORT_HELP, short_help="Bundle what a trained policy needs on a robot.")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="Bundle to make.")
def export_command(run: Path, out: Path) -> None:
    """Run `torchelev export`; its help text is `_EXPORT_HELP`."""
    from torchelev.app.bundle_command import run_export

    run_export(run, out)


_CHECK_HELP = """Replay a bundle's episode and compare.

The map in Python with what was recorded in training, the C library with the
map in Python, to the bit, and the policy in onnxruntime with the actions in
training. Where two differ, the first place is named, with the figure.

\b
  torchelev check bundle
  torchelev check bundle --library /usr/local/lib/libtorchelev.so

Exit code 0: all that was compared agrees; 1: something differs; 2: bad input.
"""


@main.command("check", help=_CHECK_HELP, short_help="Compare a bundle in Python, the C library and onnxruntime.")
@click.argument("bundle", type=click.Path(path_type=Path))
@click.option(
    "--library",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The C library to compare.  [default: this package's own]",
)
def check_command(bundle: Path, library: Path | None) -> None:
    """Run `torchelev check`; its help text is `_CHECK_HELP`."""
    from torchelev.app.bundle_command import run_check

    sys.exit(run_check(bundle, library))


main.add_command(ros2_command)
main.add_command(site_command)
