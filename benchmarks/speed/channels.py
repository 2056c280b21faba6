"""Time updates with channels beside those without, and how long it takes to paint an image onto a map.

    python -m benchmarks.speed.channels

All stages are on, and the robots drive, as in `common.workload`. Three channels may take 1.25 times the time
of none, and an image of 640 x 480 pixels 3 ms on a map of 250 x 250 cells, on two threads. Writes
benchmarks/results/channels.json.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.meter import interleaved
from benchmarks.speed.common.workload import BPEARL, MANY_POINTS, Drive, full_config
from torchelev import ChannelConfig
from torchelev.app.results import machine, markdown_table, write_json
from torchelev.frames import change_axes
from torchelev.sim import mount

MAPS = {"one robot, 43,074 points": (1, BPEARL, 250), "256 robots, 512 points": (256, MANY_POINTS, 64)}
CHANNELS: dict[str, dict[str, Any]] = {
    "none": {},
    "colour, 3 values": {"rgb": "color"},
    "3 numbers": {name: ChannelConfig() for name in ("a", "b", "c")},
    "16 numbers": {f"a{k}": ChannelConfig() for k in range(16)},
    "feature, 16 values": {"dino": ChannelConfig(kind="feature", size=16)},
}
IMAGE = (480, 640)  # pixels


class ChannelDrive(Drive):
    """Robots that drive, whose points bring values."""

    def __init__(self, channels: dict[str, Any], robots: int, points: int, cells: int) -> None:
        super().__init__(replace(full_config(cells), channels=channels), points, robots)
        g = torch.Generator().manual_seed(0)
        self.features = {
            name: torch.rand(robots, points, cfg.size, generator=g) for name, cfg in self.emap.cfg.channels.items()
        }

    def __call__(self) -> None:
        """Fuse the next scan."""
        points, T = self.next_scan()
        self.emap.update(points, T, T, self.dt, features=self.features or None)


def time_updates(seconds: float) -> list[dict[str, Any]]:
    """Time updates with each kind of channels, interleaved, and the memory of the channels."""
    rows = []
    for name, (robots, points, cells) in MAPS.items():
        drives = {kind: ChannelDrive(channels, robots, points, cells) for kind, channels in CHANNELS.items()}
        for drive in drives.values():
            drive.watch(40)
        times = interleaved(drives, seconds, rounds=8)
        for kind, row in times.items():
            channels = drives[kind].emap.channels
            memory = 0 if channels is None else sum(buffer.nbytes for buffer in channels.buffers()) / robots
            ratio = row["median"] / times["none"]["median"]
            rows.append({"maps": name, "channels": kind, **row, "ratio": ratio, "bytes_per_robot": memory})
    return rows


def time_painting(seconds: float) -> list[dict[str, Any]]:
    """Time `paint` on a map of 250 x 250 cells that a camera looks along."""
    drive = ChannelDrive({"rgb": "color"}, 1, BPEARL, 250)
    drive.watch(40)
    h, w = IMAGE
    image = torch.rand(1, 3, h, w)
    K = torch.tensor([[500.0, 0.0, (w - 1) / 2], [0.0, 500.0, (h - 1) / 2], [0.0, 0.0, 1.0]])
    T = drive.poses[0] @ mount(pitch_deg=30.0, x=0.3, z=0.2)
    T = change_axes(T, "forward", "optical")
    bytes_of = (255 * image).to(torch.uint8)
    runs: dict[str, Callable[[], Any]] = {
        "float32": lambda: drive.emap.paint(image, K, T, "rgb"),
        "uint8": lambda: drive.emap.paint(bytes_of, K, T, "rgb"),
        "float32, with a lens": lambda: drive.emap.paint(image, K, T, "rgb", distortion=(-0.1, 0.02, 1e-3, 1e-3)),
    }
    painted = float(drive.emap.layer("rgb.red").isfinite().float().mean())
    return [{"image": name, **row, "painted": painted} for name, row in interleaved(runs, seconds, rounds=8).items()]


def table(result: dict[str, Any]) -> str:
    """Tabulate times [ms] beside those without channels, and the memory."""
    rows = [
        [
            row["maps"],
            row["channels"],
            f"{row['median']:.2f}",
            f"{row['ratio']:.2f}",
            f"{row['bytes_per_robot'] / 1e3:.0f}",
        ]
        for row in result["updates"]
    ]
    updates = markdown_table(["maps", "channels", "median ms", "times none", "kB a robot"], rows)
    lines = [[row["image"], f"{row['median']:.2f}", f"{row['min']:.2f}"] for row in result["painting"]]
    painting = markdown_table(["image of 640 x 480 onto 250 x 250 cells", "median ms", "min ms"], lines)
    return f"{updates}\n\n{painting}\n\n{result['threads']} threads."


@click.command(help=__doc__)
@click.option("--seconds", default=10.0, show_default=True, help="Time per row [s].")
def main(seconds: float) -> None:
    """Measure, write JSON and print the tables."""
    torch.set_num_threads(2)
    updates, painting = time_updates(seconds), time_painting(seconds)
    result = {"machine": machine(), "threads": 2, "updates": updates, "painting": painting}
    write_json(RESULTS / "channels.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
