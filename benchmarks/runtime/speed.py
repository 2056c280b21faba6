"""How long the C library takes: from a process's start to its first map, an update beside Python's, a loop of 50 Hz.

Start and memory are those of the example `loop` with one scan of 43,074 points: it reads its config, creates the map,
maps the scan and reads a height scan. Python does the same with `ElevationMap`. Updates are timed in turns.
"""

from __future__ import annotations

import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.runtime.build import build, machine, write_config, write_stream
from benchmarks.speed.common.workload import BPEARL
from benchmarks.speed.loop import busy_process

_PYTHON = """
import sys, time, numpy as np, torch
import torchelev as te
torch.set_num_threads({threads})
from torchelev.runtime.stream import HEAD
cfg = te.ElevationMapConfig.load({config!r})
emap, scan = te.ElevationMap(cfg), te.HeightScan.isaac_lab()
times, file = [], open({stream!r}, 'rb')
with torch.inference_mode():
    while len(head := file.read(HEAD.itemsize)):
        head = np.frombuffer(head, HEAD)[0]
        S, N = int(head['num_sensors']), int(head['num_points'])
        T = torch.from_numpy(np.frombuffer(file.read(128 * S)).reshape(1, S, 4, 4).copy())
        points = torch.from_numpy(np.frombuffer(file.read(12 * S * N), np.float32).reshape(1, S, N, 3).copy())
        base, dt = torch.from_numpy(head['T_map_base'].copy())[None], float(head['dt'])
        start = time.perf_counter()
        emap.update(points, T, base, dt)
        scan(emap, base)
        times.append(1e3 * (time.perf_counter() - start))
times.sort()
p50, p99 = (times[int(q * (len(times) - 1))] for q in (0.5, 0.99))
print(f"{{len(times)}} updates: p50 {{p50:.2f}} ms, p99 {{p99:.2f}} ms", file=sys.stderr)
"""


def _times(text: str) -> dict[str, float]:
    p50, p99 = map(float, re.findall(r"p\d+ ([0-9.]+) ms", text))
    return {"p50": p50, "p99": p99}


def _run(command: list[str], stream: Path) -> dict[str, float]:
    """Run a program on a stream; return its own times [ms], its wall time [ms] and its peak memory [MB]."""
    start = time.perf_counter()
    with stream.open("rb") as file:
        done = subprocess.run(["/usr/bin/time", "-f", "%M kB", *command], stdin=file, capture_output=True, check=True)
    wall = 1e3 * (time.perf_counter() - start)
    text = done.stderr.decode()
    memory = int(re.findall(r"(\d+) kB", text)[-1]) / 1024
    return {**_times(text), "wall": round(wall, 1), "memory": round(memory, 1)}


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: round(statistics.median(row[name] for row in rows), 2) for name in rows[0]}


def measure(rounds: int, seconds: float) -> dict[str, Any]:
    """Return the figures: medians of rounds in turns."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config, one, many = folder / "map.json", folder / "one", folder / "many"
        write_config(config)
        write_stream(one, 1)
        write_stream(many, max(100, round(50 * seconds)))
        loop = str(build(folder / "build")["loop"])
        runs: dict[str, list[dict[str, float]]] = {}
        for _ in range(rounds):
            for threads in (1, 2):
                c = [loop, str(config), "isaac_lab", str(threads)]
                for label, stream in (("first map", one), ("updates", many)):
                    code = _PYTHON.format(threads=threads, config=str(config), stream=str(stream))
                    pair = {"C": c, "Python": [sys.executable, "-c", code]}
                    for kind, command in pair.items():
                        runs.setdefault(f"{label}, {kind}, {threads} threads", []).append(_run(command, stream))
        hertz = [loop, str(config), "isaac_lab", "2", "50"]
        for _ in range(rounds):
            runs.setdefault("50 Hz, idle", []).append(_run(hertz, many))
            with busy_process():
                runs.setdefault("50 Hz, beside a busy process", []).append(_run(hertz, many))
    return {"points": BPEARL, **machine(), "rounds": rounds, "rows": {k: _medians(v) for k, v in runs.items()}}
