"""Latency of a site's service: eight robots at 1 Hz, from a window to the version that holds it.

    python -m benchmarks.speed.site.site_service  # benchmarks/results/site_service.json, five minutes

The merger is `torchelev site serve` in a process of its own, the robots are threads of another one, all on this machine
and its loopback. Each robot walks 1 m in a second, knows all of its 8 x 8 m at 10 cm, of which it has measured half
anew, and publishes once a second: at times of its own, or all at once. A latency counts from the call of `publish` to
the acknowledgement, when the merge is on disk and the robot knows its version.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from benchmarks import RESULTS
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.site import SiteMap
from torchelev.site.service import RobotLink
from torchelev.site.service.wire.transport import ZenohChannel, open_session

RESOLUTION, LENGTH, ROBOTS = 0.1, 8.0, 8
SPACING = 6.0  # [m] between the robots, whose windows overlap
SPEED = 10  # [cells/s]
_WARM_UP = 3  # windows of each robot that do not count


class CountingChannel(ZenohChannel):
    """A channel that counts what it sends."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.num_sent, self.num_bytes = 0, 0

    def send(self, payload: bytes) -> None:
        """Send a message, and count it."""
        self.num_sent, self.num_bytes = self.num_sent + 1, self.num_bytes + len(payload)
        super().send(payload)


class Robot:
    """A robot that walks along x and measures half of its window each second.

    Args:
        number: of the robot.
        session: of Zenoh.
    """

    def __init__(self, number: int, session: Any) -> None:
        grid = GridConfig(resolution=RESOLUTION, length_x=LENGTH, length_y=LENGTH)
        self.emap, self.channel = (
            ElevationMap(ElevationMapConfig(grid=grid)),
            CountingChannel(session, "site", str(number)),
        )
        self.emap.corner.copy_(torch.tensor([[0, round(number * SPACING / RESOLUTION)]]))
        self.link = RobotLink(self.emap, str(number), channel=self.channel)
        self.latencies: list[float] = []
        self._generator = torch.Generator().manual_seed(number)

    def measure(self) -> None:
        """Walk for a second, and measure."""
        state = self.emap.state
        state.elapsed.add_(10**9)
        self.emap.corner[:, 0] += SPEED
        x, y = self.emap.cell_centers().unbind(-1)
        noise = 0.005 * torch.randn(x.shape, generator=self._generator)
        is_measured = torch.rand(x.shape, generator=self._generator) < 0.5
        entered = torch.zeros_like(is_measured)
        entered[:, -SPEED:] = True
        for layer in (state.elevation, state.time):
            layer.copy_(layer.roll(-SPEED, 1))
        is_measured |= entered | ~state.validity
        height = 0.3 * torch.sin(0.3 * x) * torch.cos(0.2 * y) + noise
        state.elevation.copy_(torch.where(is_measured, height, state.elevation))
        state.time.copy_(torch.where(is_measured, 0.0, state.time + 1.0))
        state.variance.copy_(1e-4 + 1e-7 * state.time)
        state.validity.fill_(True)
        state.has_normal.fill_(True)

    def run(self, start: float, phase: float, seconds: int) -> None:
        """Publish once a second, and note the latencies."""
        for k in range(seconds):
            self.measure()
            time.sleep(max(0.0, start + phase + k - time.monotonic()))
            before = time.perf_counter()
            self.link.publish()
            assert self.link.flush(30.0)
            self.latencies.append(time.perf_counter() - before)


def measure(engine: str, at_once: bool, seconds: int) -> dict[str, Any]:
    """Run the robots for some seconds; return the latencies [ms] and the traffic."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "site"
        SiteMap(RESOLUTION, folder, engine=engine).close()  # type: ignore[arg-type]
        endpoint = f"tcp/127.0.0.1:{_free_port()}"
        merger = _start_merger(folder, endpoint)
        try:
            session = open_session("peer", connect=endpoint)
            robots = [Robot(k, session) for k in range(ROBOTS)]
            start = time.monotonic() + 1.0
            phases = [0.0 if at_once else k / ROBOTS for k in range(ROBOTS)]
            threads = [
                threading.Thread(target=robot.run, args=(start, phase, seconds))
                for robot, phase in zip(robots, phases, strict=True)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            for robot in robots:
                robot.link.close()
            session.close()
        finally:
            merger.send_signal(signal.SIGINT)
            merger.wait(30.0)
        with SiteMap.open(folder, read_only=True) as site:
            num_bytes = site.num_bytes
    latencies = 1e3 * np.array([robot.latencies[_WARM_UP:] for robot in robots])
    median, late = np.percentile(latencies, [50, 99])
    sent, sent_bytes = (sum(getattr(robot.channel, each) for robot in robots) for each in ("num_sent", "num_bytes"))
    own = {"engine": engine, "at_once": at_once, "windows": latencies.size, "p50_ms": median, "p99_ms": late}
    return own | {"max_ms": latencies.max(), "bytes_per_window": sent_bytes / sent, "disk_bytes": num_bytes}


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _start_merger(folder: Path, endpoint: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "torchelev", "site", "serve", str(folder), "--quiet", "--listen", endpoint]
    env = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    merger = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env)
    assert merger.stdout is not None and merger.stdout.readline(), "the merger did not start"
    return merger


def table(result: dict[str, Any]) -> str:
    """Tabulate latencies [ms] and traffic."""
    rows = []
    for row in result["rows"]:
        times = "all at once" if row["at_once"] else "each at its own time"
        latencies = [f"{row[name]:.0f}" for name in ("p50_ms", "p99_ms", "max_ms")]
        sizes = [f"{row['bytes_per_window'] / 1e3:.0f}", f"{row['disk_bytes'] / 1e6:.0f}"]
        rows.append([row["engine"], times, f"{row['windows']:,}", *latencies, *sizes])
    head = ["engine", "robots publish", "windows", "p50 [ms]", "p99 [ms]", "longest [ms]"]
    return markdown_table([*head, "sent per window [kB]", "on disk at the end [MB]"], rows)


@click.command(help=__doc__)
@click.option("--seconds", default=60, show_default=True, help="Of each row.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS, show_default=True, help="Folder to write to.")
def main(seconds: int, out: Path) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(1)
    rows = [measure(engine, at_once, seconds) for engine in ("icechunk", "files") for at_once in (False, True)]
    result = {"robots": ROBOTS, "resolution": RESOLUTION, "length": LENGTH, "seconds": seconds, "rows": rows}
    write_json(out / "site_service.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
