"""How good are maps whose poses come from the clouds?

    python -m benchmarks.quality.odometry


A robot drives 100 m over rough ground with a lidar of 32 rings that turns while the robot moves; ranges have an error
of 2 cm. Its bag is mapped with true poses, and with `--odometry kiss-icp` (z up by the ground, and by an IMU). Every
tenth scan the map is compared with the ground around the robot: placed by the first pose, and by the present one.
Writes benchmarks/results/odometry.json.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.quality.odometry.bags import CLOUDS, IMU, START, write_drive
from benchmarks.quality.odometry.drive import Drive
from benchmarks.quality.odometry.report import table
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import write_json
from torchelev.io import MappingRun
from torchelev.io.bags import Bag, BagRecording, BagRequest, open_bag

_RADIUS, _EVERY = 5.0, 10  # [m] around the robot, and scans between two comparisons
_CASES = {
    "true poses": BagRequest(clouds=[CLOUDS]),
    "KISS-ICP, z by the ground": BagRequest(clouds=[CLOUDS], odometry="kiss-icp"),
    "KISS-ICP, z by an IMU": BagRequest(clouds=[CLOUDS], odometry="kiss-icp", imu=IMU),
}


def measure(distance: float, seed: int) -> dict[str, Any]:
    """Drive, map with each kind of poses, and compare."""
    drive = Drive(distance=distance, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        known, unknown = Path(folder) / "known.mcap", Path(folder) / "unknown.mcap"
        write_drive(known, drive, drive.num_scans, poses=True)
        write_drive(unknown, drive, drive.num_scans)
        rows = [
            {"poses": name, **_map(unknown if request.odometry else known, request, drive)}
            for name, request in tqdm(_CASES.items(), unit="map", disable=None)
        ]
    return {"distance": distance, "scans": drive.num_scans, "seed": seed, "rows": rows}


def _map(path: Path, request: BagRequest, drive: Drive) -> dict[str, float]:
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=20.0, length_y=20.0)))
    run, local, absolute, drift = MappingRun(emap), [], [], []
    with Bag(path) as bag:
        scans = open_bag(bag, request)
        T_true_map = _place_map(scans, drive)
        for k, frame in enumerate(scans):
            if frame is None or frame.T_map_base is None:
                continue
            run.add(frame, frame.T_map_base)
            true = drive.base_at(torch.tensor([frame.stamp - START]))[0].numpy()
            drift.append(float(np.linalg.norm((T_true_map @ frame.T_map_base)[:3, 3] - true[:3, 3])))
            if k % _EVERY == _EVERY - 1:
                absolute.append(_rmse(emap, drive, T_true_map))
                local.append(_rmse(emap, drive, true @ np.linalg.inv(frame.T_map_base)))
    return {
        "end_error": drift[-1], "largest_error": max(drift), "map_rmse": float(np.median(absolute)),
        "local_rmse": float(np.median(local)), "local_rmse_95": float(np.percentile(local, 95)),
    }  # fmt: skip


def _place_map(scans: BagRecording, drive: Drive) -> NDArray[np.float64]:
    """Return the map's frame (4, 4) in that of the simulation: the same first pose of the base; z stays as it is."""
    stamps = np.array([START + drive.scan(0).stamp + 0.05])
    base = scans.tree.look_up(scans.map_frame, scans.base_frame, stamps)[0]
    true = drive.base_at(torch.from_numpy(stamps - START))[0].numpy()
    turn = np.arctan2(true[1, 0], true[0, 0]) - np.arctan2(base[1, 0], base[0, 0])
    T = np.eye(4)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:3, 3] = true[:3, 3] - T[:3, :3] @ base[:3, 3]
    return T


def _rmse(emap: ElevationMap, drive: Drive, T_true_map: NDArray[np.float64]) -> float:
    """Return the error [m] of the heights around the robot, the map being placed by T_true_map."""
    z, xy = emap.layer("elevation")[0], emap.cell_centers()[0].double()
    near = (xy - emap.center[0, :2].double()).norm(dim=-1) < _RADIUS
    known = near & z.isfinite()
    places = torch.cat([xy[known], z[known].double()[:, None]], -1) @ torch.from_numpy(T_true_map[:3, :3].T)
    places += torch.from_numpy(T_true_map[:3, 3])
    return float((places[:, 2] - drive.height(places[:, :2])).square().mean().sqrt())


@click.command(help=__doc__)
@click.option("--distance", default=100.0, show_default=True, help="Length of the drive [m].")
@click.option("--seed", default=0, show_default=True, help="Of ground and noise.")
def main(distance: float, seed: int) -> None:
    """Measure, write the JSON and print the table."""
    result = measure(distance, seed)
    write_json(RESULTS / "odometry.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
