"""What the library answers to fixed inputs: every layer, reader, filter, planner, simulated sensor and environment.

    python -m tests.answers    # records tests/answers.npz.xz anew

`tests/test_answers.py` compares. Reads the library through what users import, so
that a recording outlives a redesign.
"""

from __future__ import annotations

import lzma
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

import torchelev as te
from torchelev import sim
from torchelev.sim.exact import scenes

FILE = Path(__file__).with_suffix(".npz.xz")  # compressed as a whole, a quarter smaller
B, CELLS, RESOLUTION = 2, 24, 0.1
Answers = dict[str, np.ndarray]
# On another CPU sums round otherwise, and a choice between two may go the other way: a way, and all that follows it.
FOLLOWS_CHOICES = ("plan", "path check", "plane", "rollout")

FILTERS = [
    *((name, ("elevation",), {}) for name in (
        "box", "closing", "curvature", "dilation", "erosion", "gaussian", "inpaint_diffusion", "inpaint_minimum",
        "inpaint_navier_stokes", "inpaint_nearest", "inpaint_telea", "median", "normal_x", "normal_y", "normal_z",
        "opening", "roughness", "signed_distance", "slope", "smooth_ground", "standard_deviation", "step_height",
        "virtual_floor")),
    ("expression", (), {"formula": "elevation - 0.5 * upper_bound"}),
    ("fill_from", ("elevation", "upper_bound"), {}),
    ("maximum", ("elevation", "upper_bound"), {}),
    ("minimum", ("elevation", "upper_bound"), {}),
    ("foothold_score", ("of_slope", "of_standard_deviation", "of_signed_distance"), {}),
    ("traversability_three_part", ("of_slope", "of_step_height", "of_roughness"), {}),
]  # fmt: skip


def config(**stages: object) -> te.ElevationMapConfig:
    """Return the default config on a small window, with the body box on."""
    length = CELLS * RESOLUTION
    grid = te.GridConfig(resolution=RESOLUTION, length_x=length, length_y=length)
    body = te.BodyConfig(lower=(-0.3, -0.2, -0.3), upper=(0.3, 0.2, 0.2))
    return te.ElevationMapConfig(grid=grid, sensor=te.SensorConfig(body=body), **stages)  # type: ignore[arg-type]


def scans(count: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield clouds (B, N, 3), T_map_sensor and T_map_base of robots that walk, one of them up to a person who leaves.

    Among the points are some on the robot, below the ceiling and out of range.
    """
    worlds = (scenes.boxes(3), scenes.person(until=2.0, x=1.2, y=0.1))
    camera, mounting = sim.DepthCamera(width=32, height=24), sim.mount(40.0)
    generator = torch.Generator().manual_seed(0)
    extra = torch.tensor([[0.1, 0.0, 0.1], [0.5, 0.0, 3.0], [0.0, 0.0, 90.0]], dtype=torch.float64)
    for k in range(count):
        base = torch.eye(4, dtype=torch.float64).repeat(B, 1, 1)
        base[:, 0, 3], base[:, 2, 3] = 0.05 * k, 0.5 + 0.004 * k
        sensor = base @ mounting
        others = (extra - mounting[:3, 3]) @ mounting[:3, :3]
        seen = [camera.cast(world, T, 0.3 * k) for world, T in zip(worlds, sensor, strict=True)]
        yield torch.stack([torch.cat([sim.noisy(points, generator), others.float()]) for points in seen]), sensor, base


class Walk(NamedTuple):
    """Maps after a walk."""

    emap: te.ElevationMap
    sums: dict[str, Tensor]  # of the updates' statistics


def mapped(dtype: torch.dtype, scan_count: int = 14, **stages: object) -> Walk:
    """Return maps after a walk, on which a part of the ground rose by a floor."""
    emap = te.ElevationMap(config(**stages), B).to(dtype)
    sums = {name: torch.zeros(B) for name in te.Statistics._fields}
    for k, (points, T_map_sensor, T_map_base) in enumerate(scans(scan_count)):
        if k == scan_count - 1:
            emap.elevation[:, 13:16, 10:14] += 3.0
        emap.update(points.to(dtype), T_map_sensor, T_map_base, dt=0.3)
        sums = {name: total + getattr(emap.statistics, name) for name, total in sums.items()}
    return Walk(emap, sums)


def of_map(walk: Walk) -> Answers:
    """Return every layer and every statistic."""
    emap = walk.emap
    layers = {f"layer {name}": emap.layer(name) for name in emap.layers}
    return _arrays(layers | {f"statistic {name}": total for name, total in walk.sums.items()})


def of_readers(emap: te.ElevationMap) -> Answers:
    """Return samples, scan presets, an image, planes, and what planners and footprints say."""
    base = torch.eye(4, dtype=torch.float64).repeat(B, 1, 1)
    base[:, :3, 3] = emap.center.double()
    base[:, 2, 3] += 0.5
    feet = base[:, None, :3, 3] + torch.tensor([[0.2, 0.1, -0.5], [0.2, -0.1, -0.5]], dtype=torch.float64)
    xy = emap.center[:, None, :2] + torch.linspace(-1.1, 1.1, 30, dtype=torch.float64).view(1, 15, 2)
    out: dict[str, object] = {f"sample {mode}": emap.sample(xy, mode=mode) for mode in ("bilinear", "nearest")}
    for name, scan in {"isaac_lab": te.HeightScan.isaac_lab(), "mjlab": te.HeightScan.mjlab(),
                       "legged_gym": te.HeightScan.legged_gym(), "original": te.HeightScan.isaac_lab(fill="original"),
                       "grid": te.HeightScan.grid(length_x=1.0, length_y=0.6, resolution=0.1)}.items():  # fmt: skip
        out[f"scan {name}"] = scan(emap, base)
    out["scan feet"] = te.HeightScan.feet(num_feet=2)(emap, base, feet)
    out["image"] = te.MapImage(length_x=1.6, length_y=1.0, resolution=0.1)(emap, base)
    return _arrays(out) | of_planners(emap)


def of_planners(emap: te.ElevationMap) -> Answers:
    """Return planes, costs, ways, footprints and profiles."""
    from torchelev.planes import segment
    from torchelev.planning.footprint import check_footprint
    from torchelev.planning.path_check import check_path
    from torchelev.planning.planner import plan
    from torchelev.planning.queries import height_profile, submap
    from torchelev.planning.traversal_cost import traversal_cost

    start = emap.center[:, :2] + torch.tensor([-0.25, -0.25])
    goal = emap.center[:, :2] + torch.tensor([0.35, 0.25])
    square = torch.tensor([[0.15, 0.1], [-0.15, 0.1], [-0.15, -0.1], [0.15, -0.1]], dtype=torch.float64)
    path = plan(emap, start, goal)
    planes = segment(emap.layer("elevation"), RESOLUTION)
    return _arrays({
        "plane labels": np.stack([part.labels for part in planes]),
        "plane normals": np.array([region.normal for part in planes for region in part.regions]),
        "plane areas": np.array([region.area for part in planes for region in part.regions]),
        "cost": traversal_cost(emap),
        "plan": path,
        "path check": check_path(emap, path.poses(), square),
        "footprint": check_footprint(emap, square + goal.view(B, 1, 1, 2)),
        "profile": height_profile(emap, start[:, None], goal[:, None], 20),
        "submap": submap(emap, start, 0.6, 0.4),
    })  # fmt: skip


def of_sim() -> Answers:
    """Return terrains, what simulated sensors see of them, and the errors of sensors and poses."""
    kinds = ("flat", "slope", "stairs_up", "stairs_down", "boxes", "stepping_stones", "gaps", "rough", "rails")
    terrain = sim.terrain_grid(kinds, 1, length=4.0, seed=1)
    tiles = torch.arange(len(kinds))
    base = torch.eye(4).repeat(len(kinds), 1, 1)
    base[:, 2, 3] = 0.8
    places = torch.linspace(-1.9, 1.9, 50).view(1, 25, 2).repeat(len(kinds), 1, 1)
    out: dict[str, object] = {"terrain": terrain.truth(tiles, places)}
    patterns = {
        "camera": sim.DepthCamera(width=16, height=12),
        "lidar": sim.Lidar(rings=8, azimuths=30),
        "non-repetitive lidar": sim.NonRepetitiveLidar(rays=100),
    }
    for name, pattern in patterns.items():
        out[f"exact {name}"] = pattern.cast(scenes.stairs(), base[0].double() @ sim.mount(40.0))
        sensor = sim.MountedSensor(pattern, sim.mount(40.0).float())
        points = out[f"mounted {name}"] = sensor(terrain.field, tiles, base)
        for kind in ("depth_camera", "spinning_lidar", "leg_odometry"):
            errors = sim.preset(kind)
            out[f"{kind} {name}"] = sim.SensorErrors(errors.sensor, len(kinds), seed=2)(points, base).points
            out[f"{kind} pose"] = sim.PoseErrors(errors.pose, len(kinds), seed=2)(base, 0.1)
    return _arrays(out)


def of_rollout() -> Answers:
    """Return what TerrainNav gives for fixed actions."""
    import gymnasium

    import envs  # noqa: F401

    env = gymnasium.make("torchelev/TerrainNav-v0", perception="map")
    observation, _ = env.reset(seed=0)
    seen, rewards = [observation], []
    for k in range(10):
        observation, reward, *_ = env.step(np.array([0.8, 0.1 * np.sin(k)], np.float32))
        seen.append(observation)
        rewards.append(float(reward))
    keys = {f"rollout {name}": np.stack([one[name] for one in seen]) for name in seen[0]}
    return keys | {"rollout reward": np.array(rewards)}


def of_filters(dtype: torch.dtype) -> Answers:
    """Return every filter's layer, of a map that a walk has made."""
    steps = [te.FilterConfig(layer=f"of_{name}", filter=name, inputs=of, settings=how) for name, of, how in FILTERS]
    emap = mapped(dtype, 4, filters=tuple(steps)).emap
    return _arrays({f"filter {step.filter}": emap.layer(step.layer) for step in steps})


def _learned() -> dict[str, object]:
    return {"traversability": te.LearnedTraversabilityConfig()}


def _by_tensors(make: Callable[[], Answers]) -> Answers:
    with patch.dict(os.environ, {"TORCHELEV_NATIVE": "0"}):
        return make()


PARTS: dict[str, Callable[[], Answers]] = {
    "float32": lambda: of_map(mapped(torch.float32)),
    "float64": lambda: of_map(mapped(torch.float64)),
    "float32 by tensors": lambda: _by_tensors(lambda: of_map(mapped(torch.float32))),
    "learned": lambda: of_map(mapped(torch.float32, **_learned())),
    "readers float32": lambda: of_readers(mapped(torch.float32).emap),
    "readers float64": lambda: of_readers(mapped(torch.float64).emap),
    "filters float32": lambda: of_filters(torch.float32),
    "filters float64": lambda: of_filters(torch.float64),
    "sim": of_sim,
    "rollout": of_rollout,
}


def _arrays(values: dict[str, object]) -> Answers:
    """Return tensors, and those in tuples, as arrays."""
    out = {}
    for name, value in values.items():
        parts = dict(enumerate(value)) if isinstance(value, list | tuple) else {"": value}
        if hasattr(value, "_asdict"):
            parts = value._asdict()
        for key, part in parts.items():
            if isinstance(part, Tensor | np.ndarray):
                out[f"{name} {key}".strip()] = np.asarray(part.detach() if isinstance(part, Tensor) else part)
    return out


def machine() -> str:
    """Name what rounding depends on: torch's version, the CPU's vectors and its model."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    facts = dict(line.split(":", 1) for line in lines if ":" in line)
    model = " ".join(
        value.strip() for key, value in facts.items() if key.strip() in ("vendor_id", "cpu family", "model")
    )
    return f"torch {torch.__version__.split('+')[0]}, {torch.backends.cpu.get_cpu_capability()}, {model}"


def assert_recorded(part: str) -> None:
    """Compare the answers of a part with the recording: to the bit on its machine, else to rounding."""
    with lzma.open(FILE) as file:
        recorded = dict(np.load(file))
    same, start = str(recorded.pop("machine")) == machine(), f"{part}: "
    expected = {name.removeprefix(start): value for name, value in recorded.items() if name.startswith(start)}
    answers = PARTS[part]()
    assert sorted(answers) == sorted(expected)
    for name, value in answers.items():
        if same:
            assert value.dtype == expected[name].dtype, name
            np.testing.assert_array_equal(value, expected[name], err_msg=name)
        elif not name.startswith(FOLLOWS_CHOICES):
            assert_close(value, expected[name], name)


def assert_close(value: np.ndarray, expected: np.ndarray, name: str) -> None:
    """All but 1 % of the values agree to 1e-4 of the answer's range."""
    assert value.shape == expected.shape and value.dtype == expected.dtype, name
    value, expected = value.astype(np.float64), expected.astype(np.float64)
    finite = np.isfinite(expected)
    tolerance = 1e-4 * max(np.ptp(expected[finite]), 1e-3) if finite.any() else 0.0
    with np.errstate(invalid="ignore"):
        agrees = (np.abs(value - expected) <= tolerance) | (~finite & ~np.isfinite(value))
    assert agrees.mean() >= 0.99, f"{name}: {1 - agrees.mean():.1%} differ"


def main() -> None:
    """Record."""
    torch.set_num_threads(1)
    answers = {f"{part}: {name}": value for part, make in PARTS.items() for name, value in make().items()}
    with lzma.open(FILE, "wb", preset=9) as file:
        np.savez(file, machine=np.array(machine()), **answers)
    print(f"{len(answers)} answers, {FILE.stat().st_size / 1e6:.2f} MB, {machine()}")


if __name__ == "__main__":
    main()
