"""Run the same recordings through torchelev and through other maps that users can install.

    python -m benchmarks.peers

A peer is a file of `benchmarks/peers/maps` and runs in a process of its own, in the first of the given Pythons that can
import it; peers that none can import are left out, and named. `make peers` makes an environment with all of them. A
program becomes a peer by `--program`; `benchmarks/peers/program.py` says how it is spoken to.

Writes benchmarks/results/peers.json and peers.png.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.peers import recordings
from benchmarks.peers.process import About, find_peers, find_python, version_of
from benchmarks.peers.program import about_program
from benchmarks.peers.report import draw, tables
from benchmarks.peers.score import run
from torchelev.app.results import write_json


def _programs(_context: click.Context, _option: click.Parameter, paths: tuple[Path, ...]) -> list[About]:
    """Return what programs say of themselves."""
    try:
        return [about_program(path) for path in paths]
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


def _chosen(only: tuple[str, ...], pythons: list[str], programs: list[About]) -> dict[str, tuple[About, str]]:
    """Return the peers that run, and their Pythons; say which do not."""
    peers = [*find_peers(), *programs]
    names = [peer.name for peer in peers]
    unknown = sorted(set(only) - set(names))
    if unknown:
        raise click.UsageError(f"--only: no peer {', '.join(unknown)}; there are {', '.join(names)}")
    if len(set(names)) < len(names):
        raise click.UsageError(f"--program: another peer has this name; rename the file, there are {', '.join(names)}")
    if not programs and not only:
        click.echo("Programs are left out; give each by --program PATH (see benchmarks/peers/program.py)")
    found = {}
    for peer in peers:
        if not only or peer.name in only:
            python, reasons = ("", []) if peer.program else find_python(peer, pythons)
            if python is None:
                click.echo(f"{peer.title} is left out ({'; '.join(dict.fromkeys(reasons))}); `make peers` installs it")
            else:
                found[peer.name] = peer, python
    return found


def measure(peers: dict[str, tuple[About, str]], found: Iterable[recordings.Recording]) -> Iterator[dict[str, Any]]:
    """Yield the scores of each peer on each recording so far, recording by recording."""
    about = {
        name: {"title": peer.title, "version": version_of(peer, python), "settings": peer.settings, "takes": peer.takes}
        for name, (peer, python) in peers.items()
    }
    scores: dict[str, dict[str, Any]] = {}
    for recording in found:
        rows = scores[recording.name] = {}
        for name, (peer, python) in tqdm(peers.items(), desc=recording.name, unit="map"):
            if peer.takes == "points" or recording.setup.pinhole is not None:
                rows[name] = run(peer, python, recording)
        yield {"peers": about, "recordings": scores}


@click.command(help=__doc__)
@click.option("--only", multiple=True, help="Name of a peer's file; repeat it for several. Default: all.")
@click.option("--python", "pythons", multiple=True, help="Further Python in which peers are looked for; repeatable.")
@click.option(
    "--program", "programs", multiple=True, callback=_programs,
    type=click.Path(path_type=Path, exists=True, dir_okay=False, executable=True),
    help="Program that is a peer, named by its file without suffix; repeatable.",
)  # fmt: skip
@click.option(
    "--recordings", "folder", type=click.Path(path_type=Path, exists=True), default=None,
    help="Folder of real recordings, each a folder of scans with poses.txt.",
)  # fmt: skip
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder of the results. Default: benchmarks/results, or runs/peers with --only.",
)
def main(
    only: tuple[str, ...], pythons: tuple[str, ...], programs: list[About], folder: Path | None, out: Path | None
) -> None:
    """Measure, write JSON and picture and print the tables."""
    peers = _chosen(only, [sys.executable, *(str(Path(python).absolute()) for python in pythons)], programs)
    real = () if folder is None else recordings.real(folder)
    out = out or (Path("runs/peers") if only else RESULTS)
    out.mkdir(parents=True, exist_ok=True)
    for result in measure(peers, chain(recordings.simulated(), real)):
        write_json(out / "peers.json", result)
    draw(out / "peers.png", result)
    click.echo(tables(result))


if __name__ == "__main__":
    main()
