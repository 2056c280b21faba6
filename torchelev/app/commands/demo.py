"""`torchelev demo`."""

from __future__ import annotations

from pathlib import Path

import click

from torchelev.app.user_error import user_errors


@click.command("demo", short_help="Map a simulated walk and compare it with ground truth.")
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
            from torchelev.app.demo.recording import record_demo

            click.echo(f"wrote {record_demo(bag, seconds, not quiet)} depth images and their poses to {bag}")
            return
        from torchelev.app.demo import run_demo

        click.echo(run_demo(out=out, seconds=seconds, progress=not quiet))
    click.echo(f"wrote {out}")
