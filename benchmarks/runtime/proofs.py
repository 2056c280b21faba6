"""Proofs that take long: sanitizers over replays and damaged files, and another processor."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runtime.build import RUNTIME, build, machine, run, write_config, write_stream
from torchelev import ElevationMapConfig
from torchelev.errors import require

_SANITIZERS = {"address,undefined": "address,undefined", "thread": "thread"}
_FEET = {"pattern": [[0.1, 0.2], [-0.3, 0.0]], "fill": "inpaint"}
# As `fuzz.cpp` looks for it: the grid stays small, as a config may ask for more memory than there is.
_SMALL: dict[str, Any] = {
    "grid": {"resolution": 0.1, "length_x": 2.0, "length_y": 1.5},
    "sensor": {
        "noise_factor": 1e-4,
        "exclusion": {"slope": 0.3},
        "body": {
            "capsules": [{"link": "leg", "start": [0.0, 0.0, 0.0], "end": [0.0, 0.0, -0.3], "radius": 0.05}],
            "boxes": [{"link": "base", "center": [0.0, 0.0, 0.0], "half_lengths": [0.2, 0.1, 0.1]}],
            "padding": 0.003,
        },
    },
    "drift": {"gain": 1.0, "min_points": 5},
    "fusion": {"gate": 3.0, "edges": {"min_points": 6}},
    "raycast": {"max_range": 2.0, "min_time": 0.0},
    "overlap": {"radius": 3.0},
    "traversability": {"radius": 0.1, "critical_step": "inf"},
    "filters": [
        {"layer": "smooth", "filter": "gaussian", "sigma": 0.1},
        {"layer": "nearest", "filter": "inpaint_nearest", "inputs": ["smooth"]},
        {"layer": "lowest", "filter": "inpaint_minimum", "iterations": 3},
        {"layer": "harmonic", "filter": "inpaint_diffusion", "iterations": 9},
    ],
}
# What runs the code of other processors, and how it is built.
_OTHERS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "aarch64": (
        ("qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"),
        (
            *("-DCMAKE_SYSTEM_NAME=Linux", "-DCMAKE_SYSTEM_PROCESSOR=aarch64", "-DTORCHELEV_ARCH=armv8-a"),
            "-DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++",
        ),
    ),
    "x86-64 without AVX": ((), ("-DTORCHELEV_ARCH=x86-64-v2",)),
}


def sanitize(seconds: int) -> dict[str, Any]:
    """Replay streams and read damaged files under sanitizers, which end a program that does what C++ forbids."""
    found: dict[str, Any] = {**machine(), "seconds": seconds}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_config(folder / "map.json")
        for sensors in (1, 3):
            write_stream(folder / f"stream{sensors}", 30, sensors, 12_000)
        for kind, flag in _SANITIZERS.items():
            flags = f"-g -O1 -fsanitize={flag} -fno-sanitize-recover=all -fno-omit-frame-pointer"
            programs = build(folder / kind.replace(",", "-"), "-DCMAKE_BUILD_TYPE=None", f"-DCMAKE_CXX_FLAGS={flags}")
            for sensors in (1, 3):
                for threads in (1, 4):
                    _replay(programs["loop"], folder, sensors, threads)
            found[kind] = "30 updates of 1 and of 3 sensors on 1 and on 4 threads: nothing"
            if kind != "thread":
                (folder / "small.json").write_text(json.dumps(_SMALL))
                done = run(_build_fuzz(folder / kind.replace(",", "-"), flags), folder / "small.json", folder, seconds)
                found["damaged files"] = done.stdout.decode().strip()
    return found


def _build_fuzz(library: Path, flags: str) -> Path:
    """Build what damages files, against the library in a folder."""
    program = library / "fuzz"
    source, include = Path(__file__).with_name("fuzz.cpp"), f"-I{RUNTIME / 'include'}"
    run("c++", "-std=c++17", *flags.split(), include, source, library / "libtorchelev.a", "-pthread", "-o", program)
    return program


def _replay(loop: Path, folder: Path, sensors: int, threads: int) -> None:
    for layout in ("isaac_lab", json.dumps(_FEET)):
        with (folder / f"stream{sensors}").open("rb") as stream:
            run(loop, folder / "map.json", layout, threads, stdin=stream)


def compare_processors() -> dict[str, Any]:
    """Run the same streams by this processor's code and by others'; return how far scans and saved layers differ."""
    for tool in ("aarch64-linux-gnu-g++", "qemu-aarch64"):
        hint = "install Debian's g++-aarch64-linux-gnu and qemu-user"
        require(shutil.which(tool) is not None, tool, "must be there", "none", hint, FileNotFoundError)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ElevationMapConfig().save(folder / "map.json")
        here = build(folder / "here")["loop"]
        others = {
            kind: [*run_by, build(folder / kind, *settings)["loop"]] for kind, (run_by, settings) in _OTHERS.items()
        }
        rows = {}
        for sensors in (1, 3):
            write_stream(folder / "stream", 40, sensors, 12_000)
            expected = _scans(folder, here)
            for kind, command in others.items():
                rows[f"{kind}, {sensors} sensors"] = _difference(expected, _scans(folder, *command))
    return {**machine(), "rows": rows}


def _scans(folder: Path, *command: Any) -> dict[str, np.ndarray]:
    """Return all height scans of a stream, and the layers after it."""
    saved = folder / "saved"
    with (folder / "stream").open("rb") as stream:
        done = run(*command, folder / "map.json", "isaac_lab", 1, 0, saved, stdin=stream)
    return {"height scans": np.frombuffer(done.stdout, np.float32), **read_saved(saved)}


def read_saved(path: Path) -> dict[str, np.ndarray]:
    """Return the layers of floats of a saved map, where the elevation is known."""
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    kinds = {"F32": np.float32, "BOOL": np.uint8}

    def tensor(name: str) -> np.ndarray:
        begin, end = (8 + length + at for at in header[name]["data_offsets"])
        return np.frombuffer(data[begin:end], kinds[header[name]["dtype"]])

    layers = ("elevation", "variance", "support", "time", "upper_bound", "gradient_x", "traversability")
    return {"validity": tensor("validity"), **{name: tensor(name) for name in layers}}


def _difference(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return by layer the largest difference over the layer's range, and how many values differ at all."""
    rows = {}
    for name, value in a.items():
        spread = float(np.ptp(value)) or 1.0
        apart = np.abs(value.astype(np.float64) - b[name].astype(np.float64))
        rows[name] = {"largest": float(apart.max()) / spread, "differing": int((apart > 0).sum()), "of": value.size}
    return rows
