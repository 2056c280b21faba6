"""Peers as processes: found, started and spoken to."""

from __future__ import annotations

import ast
import contextlib
import os
import pickle
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.peers.peer import Array, Frame, Setup
from torchelev.errors import require

MAPS = Path(__file__).parent / "maps"
ROOT = MAPS.parents[2]


class About(NamedTuple):
    """What a peer's file says of itself."""

    name: str  #: of the file
    title: str
    settings: str
    needs: str  #: module of its package, empty without one
    takes: str  #: "points" or "depth"
    version: str = ""  #: where no package says it
    program: str = ""  #: path of the program that it is, if it is one


def find_peers() -> list[About]:
    """Read the constants of each peer's file, without importing it; torchelev comes first."""
    files = sorted(MAPS.glob("[!_]*.py"), key=lambda path: (path.stem != "torchelev_map", path.stem))
    return [_read(path) for path in files]


def _read(path: Path) -> About:
    values: dict[str, Any] = {}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Assign):
            names = [n.id for n in ast.walk(node.targets[0]) if isinstance(n, ast.Name)]
            if set(names) <= {"TITLE", "SETTINGS", "NEEDS", "TAKES"}:
                found = ast.literal_eval(node.value)
                values |= dict(zip(names, found if len(names) > 1 else [found], strict=True))
    missing = [key for key in ("TITLE", "SETTINGS", "NEEDS", "TAKES") if key not in values]
    require(not missing, path.name, f"must set {', '.join(missing)}", "none", "see benchmarks/peers/maps/mean.py")
    return About(path.stem, *(values[key] for key in ("TITLE", "SETTINGS", "NEEDS", "TAKES")))


def find_python(peer: About, pythons: list[str]) -> tuple[str | None, list[str]]:
    """Return the first Python in which a peer can be imported, None without one, and why the others cannot."""
    code = f"import benchmarks.peers.maps.{peer.name}"
    reasons: list[str] = []
    for python in pythons:
        try:
            done = subprocess.run([python, "-c", code], capture_output=True, text=True, cwd=ROOT, env=_environment())
        except OSError as error:
            reasons.append(f"{python}: {error.strerror}")
            continue
        if done.returncode == 0:
            return python, reasons
        reasons.append((done.stderr.strip().splitlines() or [f"{python} failed"])[-1])
    return None, reasons


def version_of(peer: About, python: str) -> str:
    """Return the version of a program, or of the package that a peer needs; empty without one, or if it is unknown."""
    if not peer.needs:
        return peer.version
    code = (
        "import importlib.metadata as m; "
        f"names = m.packages_distributions().get({peer.needs!r}, [{peer.needs!r}]); print(m.version(names[0]))"
    )
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, cwd=ROOT, env=_environment())
    return done.stdout.strip()


def _environment() -> dict[str, str]:
    threads = {name: "2" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    return {**os.environ, **threads, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"}


class Child:
    """A process that is spoken to by pipes. What it prints is shown when it fails."""

    def __init__(self, title: str, command: list[str]) -> None:
        self._title, self._printed = title, tempfile.TemporaryFile()
        pipes: dict[str, Any] = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._printed)
        self._process: Any = subprocess.Popen(command, cwd=ROOT, env=_environment(), **pipes)

    def _failed(self, how: str = "ended early") -> RuntimeError:
        """End it and return an error with its last words."""
        self.close()
        self._printed.seek(0)
        last = self._printed.read().decode(errors="replace").strip().splitlines()[-1:]
        return RuntimeError(f"{self._title} {how}: {' '.join(last) or 'it printed nothing'}")

    def close(self) -> None:
        """End it."""
        self._end()

    def _end(self) -> bytes:
        """End it and return what it sent that nobody read."""
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        left: bytes = self._process.stdout.read()
        self._process.wait()
        return left


class Process(Child):
    """A peer of `benchmarks/peers/maps` that runs in a Python."""

    def __init__(self, peer: About, python: str, setup: Setup) -> None:
        super().__init__(peer.title, [python, "-W", "ignore", "-m", "benchmarks.peers.worker", peer.name])
        self._ask(setup)

    def _ask(self, given: Any) -> Any:
        try:
            pickle.dump(given, self._process.stdin, protocol=4)
            self._process.stdin.flush()
            return pickle.load(self._process.stdout)
        except (EOFError, BrokenPipeError):
            raise self._failed() from None

    def update(self, frame: Frame) -> tuple[float, float]:
        """Give it a scan; return the seconds that it took, and those of all cores."""
        return self._ask(frame)  # type: ignore[no-any-return]

    def ground(self) -> tuple[Array, Array | None, int]:
        """Return heights [m], their standard deviations or None, and by how much its memory has grown [bytes]."""
        return self._ask(None)  # type: ignore[no-any-return]
