"""Time the updates of a 50 Hz loop, on an idle machine and beside a busy process.

    python -m benchmarks.speed.loop

A compiled map of 10 x 10 m at 4 cm fuses a scan of 43,074 points every 20 ms, and a height scan is read. The loop runs
in a new process for each way of OpenMP's threads to wait for each other: long, as OpenMP itself does; adapted, the
default, by which `ops.waiting` shortens waits beside busy processes; and OMP_WAIT_POLICY=PASSIVE. Each is timed on an
idle machine and beside a process that keeps one core busy at equal priority.

Writes p50, p99 and max [ms] and the fraction of late updates to benchmarks/results/loop.json; an update is late if it
ends after the next scan was due.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.workload import BPEARL, Drive, full_config
from torchelev import HeightScan
from torchelev.app.results import markdown_table, write_json
from torchelev.ops.waiting import SETTINGS

_PERIOD = 0.02  # [s]
_WAITS = {  # settings in the environment; the first one is OpenMP's own value
    "long": {"GOMP_SPINCOUNT": "300000"},
    "adapted": {},
    "PASSIVE": {"OMP_WAIT_POLICY": "PASSIVE"},
}
_BUSY = "import os; parent = os.getppid()\nwhile os.getppid() == parent: pass"  # ends when this process does


def loop(step: Callable[[], Any], count: int, period: float = _PERIOD) -> list[float]:
    """Call a step at a fixed rate and return the time of each call [s]; after a late call the rate stays the same."""
    times = []
    due = time.perf_counter()
    for _ in range(count):
        time.sleep(max(0.0, due - time.perf_counter()))
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
        due = max(due + period, start + times[-1])
    return times


def figures(times: list[float], period: float = _PERIOD) -> dict[str, float]:
    """Return p50, p99 and max [ms] by nearest rank, and the fraction of calls that took longer than the period."""
    ordered = sorted(times)
    p50, p99 = (1e3 * ordered[math.ceil(q * len(ordered)) - 1] for q in (0.5, 0.99))
    late = sum(t > period for t in times) / len(times)
    return {"p50": p50, "p99": p99, "max": 1e3 * ordered[-1], "late": late, "updates": len(times)}


@contextlib.contextmanager
def busy_process() -> Iterator[None]:
    """Keep one core busy with another process."""
    process = subprocess.Popen([sys.executable, "-c", _BUSY])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def measure(count: int, threads: int, compiled: bool = True, points: int = BPEARL) -> dict[str, dict[str, float]]:
    """Time the loop in this process, on an idle machine and then beside a busy process."""
    torch.set_num_threads(threads)
    drive = Drive(full_config(), points, compiled=compiled)
    if compiled:
        drive.emap.warm_up(points)
    drive.watch(8)
    scan = HeightScan.isaac_lab()

    def step() -> None:
        drive()
        scan(drive.emap, drive.poses[0])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # slow updates are what is measured
        idle = figures(loop(step, count))
        with busy_process():
            time.sleep(0.2)  # until the other process runs
            return {"idle": idle, "busy": figures(loop(step, count))}


def measure_apart(waits: str, count: int, threads: int) -> dict[str, dict[str, float]]:
    """Time the loop in a new process whose threads wait in one of the ways."""
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS} | _WAITS[waits]
    code = f"import json; from benchmarks.speed.loop import measure; print(json.dumps(measure({count}, {threads})))"
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def table(rows: dict[str, dict[str, dict[str, float]]]) -> str:
    """Tabulate the times of each way to wait and condition."""
    lines = [
        [waits, name, *(f"{row[key]:.1f}" for key in ("p50", "p99", "max")), f"{100 * row['late']:.1f}"]
        for waits, conditions in rows.items()
        for name, row in conditions.items()
    ]
    return markdown_table(["waits", "beside it", "p50 [ms]", "p99 [ms]", "max [ms]", "late [%]"], lines)


@click.command(help=__doc__)
@click.option("--seconds", default=30.0, show_default=True, help="Time per condition [s].")
@click.option("--threads", default=2, show_default=True, help="CPU threads.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(measure_row: Callable[..., Any] | None, seconds: float, threads: int, out: Path) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(threads)  # for the description of the machine
    count = max(1, round(seconds / _PERIOD))
    rows = {waits: (measure_row or measure_apart)(waits, count, threads) for waits in _WAITS}
    write_json(out / "loop.json", {"points": BPEARL, "hertz": 1 / _PERIOD, "threads": threads, "rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
