"""Run the same recordings through torchelev and through other maps that users can install.

    python -m benchmarks.peers

A peer is a file of `benchmarks/peers/maps` and runs in a process of its own, in the first of the given Pythons that can
import it; peers that none can import are left out, and named. `make peers` makes an environment with all of them.

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
from benchmarks.peers.report import draw, tables
from benchmarks.peers.score import run
from torchelev.app.results import write_json


def _chosen(only: tuple[str, ...], pythons: list[str]) -> dict[str, tuple[About, str]]:
    """Return the peers that run, and their Pythons; say which do not."""
    peers = find_peers()
    unknown = sorted(set(only) - {peer.name for peer in peers})
    if unknown:
        raise click.UsageError(f"--only: no peer {', '.join(unknown)}; there are {', '.join(p.name for p in peers)}")
    found = {}
    for peer in peers:
        if not only or peer.name in only:
            python, reasons = find_python(peer, pythons)
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
    "--recordings", "folder", type=click.Path(path_type=Path, exists=True), default=None,
    help="Folder of real recordings, each a folder of scans with poses.txt.",
)  # fmt: skip
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder of the results. Default: benchmarks/results, or runs/peers with --only.",
)
def main(only: tuple[str, ...], pythons: tuple[str, ...], folder: Path | None, out: Path | None) -> None:
    """Measure, write JSON and picture and print the tables."""
    peers = _chosen(only, [sys.executable, *(str(Path(python).absolute()) for python in pythons)])
    real = () if folder is None else recordings.real(folder)
    out = out or (Path("runs/peers") if only else RESULTS)
    out.mkdir(parents=True, exist_ok=True)
    for result in measure(peers, chain(recordings.simulated(), real)):
        write_json(out / "peers.json", result)
    draw(out / "peers.png", result)
    click.echo(tables(result))


if __name__ == "__main__":
    main()
