"""The paper's two tables and its points-against-time curve, measured on this machine.

    python -m benchmarks.paper_tables        # benchmarks/results/paper_tables.json, .png and the tables

10 x 10 m at 4 cm, one robot, every stage on, compiled: the run asserts that each stage did something. A robot drives
over flat ground with a box; the scans have the paper's numbers of points, spread over the ground. Beside it the
plain baseline that the paper compares with: transform, noise and height update alone.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
import torch.utils.benchmark as bench
from torch import Tensor
from torch.utils._pytree import tree_map

from benchmarks.report import markdown_table, write_json
from torchelev import BodyConfig, ElevationMap, ElevationMapConfig, SensorConfig
from torchelev.pipeline import compiler_options
from torchelev.state import MapState, Measurement
from torchelev.storage import as_bytes, as_mask

# The paper's Table II: sensor, points, its map update rate on a Jetson Xavier [Hz], the sensor's rate [Hz].
SENSORS = [
    ("Realsense filtered", 6276, 49.4, 60),
    ("Realsense raw", 407040, 16.1, 60),
    ("Bpearl", 43074, 19.99, 20),
]
TARGETS = {43074: 8.0, 407040: 25.0}  # [ms]
CURVE = [1000, 3000, 6276, 15000, 43074, 100000, 200000, 407040]


def full_config() -> ElevationMapConfig:
    """Return the default 10 x 10 m map at 4 cm with the body box on too."""
    return ElevationMapConfig(sensor=SensorConfig(body=BodyConfig(lower=(-0.6, -0.3, -0.7), upper=(0.6, 0.3, 0.3))))


def baseline_config() -> ElevationMapConfig:
    """Return transform, noise and height update alone, as the paper's baseline."""
    cfg = full_config()
    fusion, sensor = replace(cfg.fusion, edges=None), replace(cfg.sensor, exclusion=None, body=None)
    return replace(cfg, fusion=fusion, sensor=sensor, drift=None, raycast=None, overlap=None, traversability=None)


def cloud(num_points: int, phase: int, generator: torch.Generator) -> Tensor:
    """Make a scan (1, N, 3): ground, a box that comes and goes, an overhang, the robot's body and outliers."""
    azimuth = torch.rand(num_points, generator=generator) * 2 * math.pi
    fall = 0.14 + 0.9 * torch.rand(num_points, generator=generator)  # downward slope of the ray
    r = 0.8 / fall
    z = -0.8 + 0.005 * torch.randn(num_points, generator=generator)
    x, y = r * azimuth.cos(), r * azimuth.sin()
    hits_box = (phase % 2 == 0) & (azimuth < 0.5) & (r > 1.5)
    scale = torch.where(hits_box, 1.5 / r, 1.0)
    points = torch.stack([x * scale, y * scale, torch.where(hits_box, -fall * 1.5, z)], -1)
    which = torch.rand(num_points, generator=generator)
    points[which < 0.01] *= 0.7  # dust
    overhang = (which > 0.01) & (which < 0.02)
    points[overhang] = points[overhang] * torch.tensor([1.0, 1.0, -1.2])
    body = (which > 0.02) & (which < 0.03)
    points[body] = 0.3 * (torch.rand(int(body.sum()), 3, generator=generator) - 0.5)
    return points[None]


class Drive:
    """A robot on its way: every call fuses the next scan."""

    def __init__(self, cfg: ElevationMapConfig, num_points: int, compiled: bool = True, scans: int = 8) -> None:
        generator = torch.Generator().manual_seed(0)
        self.emap = ElevationMap(cfg)
        if compiled:
            self.emap.compile()
        self.clouds = [cloud(num_points, k, generator) for k in range(scans)]
        self.step = 0
        self.seen: dict[str, float] = {}

    def __call__(self) -> None:
        """Fuse the next scan."""
        points, T = self.next_scan()
        self.emap.update(points, T, T, 0.6)

    def next_scan(self) -> tuple[Tensor, Tensor]:
        """Return the scan and the pose: to and fro by 4 cm a step, sinking and rising by a millimetre."""
        k, self.step = self.step, self.step + 1
        T = torch.eye(4, dtype=torch.float64)[None].clone()
        T[:, 0, 3], T[:, 2, 3] = 0.04 * abs(k % 40 - 20), 0.8 + 0.001 * (k % 7)
        return self.clouds[k % len(self.clouds)], T

    def watch(self, updates: int) -> None:
        """Run some updates and note what each stage did."""
        for _ in range(updates):
            self()
            for name, value in self.emap.statistics._asdict().items():
                self.seen[name] = max(self.seen.get(name, 0.0), float(value.abs().max()))


def milliseconds(run: Callable[[], None], seconds: float) -> dict[str, float]:
    """Time a callable by torch's benchmark tool: median, minimum and interquartile range [ms]."""
    threads = torch.get_num_threads()
    timer = bench.Timer("run()", globals={"run": run}, num_threads=threads)
    m = timer.blocked_autorange(min_run_time=seconds)
    return {"median": m.median * 1e3, "min": min(m.times) * 1e3, "iqr": m.iqr * 1e3}


def assert_all_stages_ran(drive: Drive) -> None:
    """Refuse a timing in which some stage had nothing to do."""
    idle = [name for name, value in drive.seen.items() if value == 0 and name not in ("rejected_invalid",)]
    assert not idle, f"stages without effect in the timed run: {idle}"


def put_upstairs(drive: Drive) -> None:
    """Raise a part of the map by a floor, so that overlap clearance has work in the run that is watched."""
    emap = drive.emap
    emap.elevation[:, 100:110, 100:110] += 3.0


def measure_points(cfg: ElevationMapConfig, num_points: int, seconds: float, all_stages: bool) -> dict[str, Any]:
    """Time updates with this many points."""
    drive = Drive(cfg, num_points)
    drive.watch(8)
    if all_stages:
        put_upstairs(drive)
        drive.watch(24)
        assert_all_stages_ran(drive)
    result = milliseconds(drive, seconds) | {"points": num_points}
    return result | ({"largest_statistics": drive.seen} if all_stages else {})


def stage_times(num_points: int, seconds: float) -> dict[str, float]:
    """Time each stage compiled on its own (paper, Table I). Their sum exceeds the whole, which the compiler fuses."""
    from torchelev import aging, drift, fusion, grid, overlap, pipeline, raycast, sensor

    cfg = full_config()
    drive = Drive(cfg, num_points, compiled=False)
    drive.watch(8)
    points, T = drive.next_scan()
    dt = torch.tensor([0.6])
    g = cfg.grid
    assert cfg.drift and cfg.raycast and cfg.overlap and cfg.traversability

    def transform(state: MapState, m: Measurement) -> Measurement:
        return sensor.measure(points[:, None], T[:, None], T, dt, None, g, cfg.sensor, torch.float32)

    stages: dict[str, Callable[[MapState, Measurement], Any]] = {
        "point transform, gates, noise": transform,
        "recenter": lambda state, m: grid.recenter(state, m, g),
        "age": lambda state, m: aging.age(state, m, cfg.aging),
        "drift compensation": lambda state, m: drift.compensate(state, m, g, cfg.drift),
        "height update": lambda state, m: fusion.fuse(state, m, g, cfg.fusion),
        "ray casting": lambda state, m: raycast.clear_seen_through(state, m, g, cfg.raycast),
        "overlap clearance": lambda state, m: overlap.clear_other_floors(state, m, g, cfg.overlap),
        "normals and traversability": lambda state, m: pipeline.rate_surface(state, cfg),
    }
    state, m = drive.emap.state, transform(drive.emap.state, None)  # type: ignore[arg-type]
    times = {}
    with torch.no_grad():
        for name, stage in stages.items():
            torch._dynamo.reset()  # the stages share a function, of which the compiler keeps no more than 8 versions
            compiled = torch.compile(bytewise(stage), fullgraph=True, options=compiler_options())
            inputs = mask_bytes((state, m))
            compiled(inputs)
            times[name] = milliseconds(lambda run=compiled, inputs=inputs: run(inputs), seconds)["median"]
    return times


def mask_bytes(values: Any) -> Any:
    """Return the values with their masks as bytes."""
    return tree_map(lambda t: as_bytes(t) if isinstance(t, Tensor) and t.dtype == torch.bool else t, values)


def bytewise(stage: Callable[[MapState, Measurement], Any]) -> Callable[[Any], Any]:
    """Let masks come and go as bytes, as in the whole update."""

    def run(inputs: Any) -> Any:
        masks = tree_map(lambda t: as_mask(t) if isinstance(t, Tensor) and t.dtype == torch.uint8 else t, inputs)
        return mask_bytes(stage(*masks))

    return run


def plot(path: str, full: list[dict[str, Any]], plain: list[dict[str, Any]]) -> None:
    """Draw points against time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for rows, label, style in ((full, "all stages", "o-"), (plain, "plain baseline", "s--")):
        axes.plot([r["points"] for r in rows], [r["median"] for r in rows], style, label=label)
    for name, points, _, _ in SENSORS:
        axes.axvline(points, color="0.8", zorder=0)
        axes.text(points, axes.get_ylim()[1], f" {name}", rotation=90, va="top", ha="right", fontsize=7, color="0.4")
    axes.set(xscale="log", xlabel="points", ylabel="time per update [ms]", title="10 x 10 m at 4 cm, CPU")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure, print the tables, write JSON and plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="benchmarks/results", help="folder for the results (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=2.0, help="time for each figure [s] (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    full = [measure_points(full_config(), n, args.seconds, True) for n in CURVE]
    plain = [measure_points(baseline_config(), n, args.seconds, False) for n in CURVE]
    eager = Drive(full_config(), 43074, compiled=False)
    eager.watch(3)
    eager_ms = milliseconds(eager, args.seconds)
    stages = stage_times(43074, args.seconds / 4)

    print("\nTime per stage, 43,074 points, each compiled alone\n")
    print(markdown_table(["stage", "ms"], [[k, f"{v:.2f}"] for k, v in stages.items()]))
    print("\nUpdate rate\n")
    median = {row["points"]: row["median"] for row in full}
    rows = [[s, f"{n:,}", f"{median[n]:.1f}", f"{1e3 / median[n]:.0f}", f"{hz}", f"{r}"] for s, n, hz, r in SENSORS]
    print(markdown_table(["sensor", "points", "ms", "Hz here", "Hz in the paper (Jetson Xavier)", "sensor Hz"], rows))
    print("\nPoints against time [ms]\n")
    both = [[f"{a['points']:,}", f"{a['median']:.2f}", f"{b['median']:.2f}"] for a, b in zip(full, plain, strict=True)]
    print(markdown_table(["points", "all stages", "plain baseline"], both))
    for n, target in TARGETS.items():
        print(f"{n:,} points: {median[n]:.1f} ms, target {target} ms: {'met' if median[n] <= target else 'MISSED'}")
    values = {"config": full_config().to_dict(), "all_stages": full, "plain_baseline": plain}
    values |= {"eager_43074": eager_ms, "stages_43074": stages, "targets_ms": TARGETS}
    write_json(f"{args.out}/paper_tables.json", values)
    plot(f"{args.out}/paper_tables.png", full, plain)


if __name__ == "__main__":
    main()
