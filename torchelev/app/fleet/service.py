"""The fleet's site map as a service: a merger in a process of its own, and a link of each robot to it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import torch

import torchelev
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.io.export import SavedMap
from torchelev.site import MergeReport, SiteMap
from torchelev.site.service import RobotLink
from torchelev.site.service.wire.transport import ZenohChannel, open_session

_NAME = "fleet"
_PATIENCE = 30.0  # [s] for the merger to acknowledge, and to end


class FleetService:
    """Merges the maps of a fleet in another process, over the loopback. Has what a mission needs of a `SiteMap`.

    Args:
        emap: the map of B robots, each of which has a link of its own.
        folder: of the site map.
        seconds: [s] that are simulated at most: the robots' clocks start so long ago, and never run ahead.

    Raises:
        OSError: the merger does not start.
        ModuleNotFoundError: eclipse-zenoh is missing.
    """

    def __init__(self, emap: ElevationMap, folder: Path, seconds: float) -> None:
        self._folder, self._start = folder, time.time() - seconds
        self.endpoint = f"tcp/127.0.0.1:{_free_port()}"
        self._process = _start_merger(folder, emap.cfg.grid.resolution, self.endpoint)
        self._session = open_session("peer", connect=self.endpoint)
        self.links = [
            RobotLink(emap, name, envs=torch.tensor([k]), channel=ZenohChannel(self._session, _NAME, name))
            for k, name in enumerate(f"robot-{k + 1}" for k in range(emap.num_envs))
        ]

    def merge(self, emap: ElevationMap) -> MergeReport:
        """Let all robots publish, wait until the site has it, and return the merger's report on each of them."""
        now = self._start + 1e-9 * float(emap.state.elapsed.max())
        for link in self.links:
            link.publish(now)
        end = time.monotonic() + _PATIENCE
        is_merged = all([link.flush(max(0.0, end - time.monotonic())) for link in self.links])
        hint = "look at what it printed"
        require(is_merged, "merger", f"must answer within {_PATIENCE:g} s", "no answer", hint, OSError)
        reports = [link.report for link in self.links if link.report is not None]
        report = MergeReport(*map(torch.cat, zip(*reports, strict=True)))
        return report._replace(contradictions=report.contradictions.clamp(min=0))  # -1: not known

    def window(self, center: tuple[float, float], length_x: float, length_y: float) -> SavedMap:
        """Return an area as the merger sends it."""
        return self.links[0].window(center, length_x, length_y, timeout=_PATIENCE)

    @property
    def version(self) -> str:
        """The newest version of the site that the robots have heard of."""
        return self.links[0].version

    @property
    def num_bytes(self) -> int:
        """Bytes on disk."""
        with SiteMap.open(self._folder, read_only=True) as site:
            return site.num_bytes

    def close(self) -> None:
        """End the links and the merger."""
        for link in self.links:
            link.close()
        self._session.close()
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _start_merger(folder: Path, resolution: float, endpoint: str) -> subprocess.Popen[str]:
    """Start `torchelev site serve` and wait until it serves."""
    command = [sys.executable, "-m", "torchelev", "site", "serve", str(folder), "--quiet"]
    command += ["--name", _NAME, "--resolution", str(resolution), "--listen", endpoint]
    package = str(Path(torchelev.__file__).parents[1])  # which may be found by the present folder alone
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])}
    # In a session of its own: Ctrl-C is for the mission, which merges once more and then ends the merger.
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True, env=env)
    assert process.stdout is not None
    if not process.stdout.readline():
        raise OSError(
            f"merger: must start, got exit code {process.wait()}; try `torchelev site serve {folder}` by hand"
        )
    return process
