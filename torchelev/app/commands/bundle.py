"""`torchelev export` and `torchelev check`: a policy's bundle."""

from __future__ import annotations

import sys
from pathlib import Path

import click

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


@click.command("export", help=_EXPORT_HELP, short_help="Bundle what a trained policy needs on a robot.")
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


@click.command("check", help=_CHECK_HELP, short_help="Compare a bundle in Python, the C library and onnxruntime.")
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
