"""Is `diagnose()` silent on sound scenes? Writes benchmarks/results/silence.json.

    python -m benchmarks.quality.silence [SCENES]

Scenes are drawn over terrains, sensors, mounts, range noise, speeds, sway and windows; poses are true.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim import DepthCamera, Lidar, mount, range_noise, walk
from torchelev.sim.exact import scenes

OUT = Path(__file__).parents[1] / "results" / "silence.json"
_DT, _NUM_SCANS = 0.2, 12  # [s], updates of each scene


def diagnose_scene(seed: int) -> tuple[str, list[str]]:
    """Return the terrain and the findings of `diagnose` on a walk over it."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    kinds = {
        "slope": lambda: scenes.slope(rng.uniform(0, 25)),
        "rough": lambda: scenes.rough(seed),
        "stairs": scenes.stairs,
        "boxes": lambda: scenes.boxes(seed),
        "mixed": lambda: scenes.mixed(seed),
        "wall": scenes.wall,
        "overhang": scenes.overhang,
        "person": lambda: scenes.person(2.0),
        "flat": scenes.flat,
    }
    name = list(kinds)[seed % len(kinds)]
    scene = kinds[name]()
    is_camera = rng.random() < 0.5
    sensor: DepthCamera | Lidar
    if is_camera:
        sensor, pitch = DepthCamera(64, 48, max_range=rng.uniform(4, 10)), rng.uniform(10, 50)
    else:
        rings = int(rng.choice([8, 16, 32]))
        sensor, pitch = Lidar(rings, 256, fov_high_deg=15.0, max_range=rng.uniform(8, 40)), rng.uniform(-5, 20)
    T_base_sensor = mount(pitch, z=float(rng.choice([0.1, 0.25, 0.5, 1.5])))
    start, end = rng.uniform(-2, 2, (2, 2))
    motion = dict(speed=rng.uniform(0.2, 1.5), sway=rng.uniform(0, 1.5))
    path = walk(scene, [tuple(start), tuple(end)], dt=_DT, T_base_sensor=T_base_sensor, **motion)
    size, resolution = float(rng.choice([4, 8, 16])), float(rng.choice([0.04, 0.1, 0.2]))
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=resolution, length_x=size, length_y=size)))
    noise = rng.choice([0.0, 1.0, 2.0])
    for k in range(min(_NUM_SCANS, len(path.times))):
        points = sensor.cast(scene, path.T_map_sensor[k], float(path.times[k]))
        if noise:
            points = range_noise(points, generator, constant=0.003 * noise, quadratic=0.0015 * noise)
        emap.update(points[None], path.T_map_sensor[k, None], path.T_map_base[k, None], dt=_DT)
    return f"{name}, {'camera' if is_camera else 'lidar'}, noise x {noise:g}", emap.diagnose()


def main(num_scenes: int = 100) -> None:
    """Diagnose the scenes, print and write what was said."""
    alarms = {}
    for seed in range(num_scenes):
        name, sentences = diagnose_scene(seed)
        if sentences:
            alarms[f"{seed}: {name}"] = sentences
            print(seed, name, sentences, flush=True)
    OUT.write_text(json.dumps({"scenes": num_scenes, "alarms": alarms}, indent=1) + "\n")
    print(f"{len(alarms)} of {num_scenes} sound scenes raised an alarm")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
