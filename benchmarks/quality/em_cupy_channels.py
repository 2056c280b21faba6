"""How near channels come to the semantic layers that elevation_mapping_cupy's own code computed.

Its kernels round points, poses and cells to float16. The points here are rounded in the same way before the update, so
that both put them into the same cells. Compared are cells of which the scan's points were all accepted: there, sums are
over all of them, but divided by the number of accepted ones. Run by `benchmarks.quality.em_cupy`.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev import ElevationMap, ElevationMapConfig
from torchelev.app.results import markdown_table
from torchelev.io.em_cupy.channels import read_channels
from torchelev.stages.like_em_cupy import DEFAULTS

SCENES = ("average", "class_average", "color", "mixed")
TOLERANCE, LEVEL = 1e-3, 1.01 / 255  # of values; of colours, which are whole numbers there
WITHOUT = {f"enable_{name}": False for name in ("visibility_cleanup", "drift_compensation", "overlap_clearance")}
Array = NDArray[Any]


def evaluate_channels(folder: Path) -> dict[str, float]:
    """Return the lowest share of cells that agree, of all frames and channels, by scene."""
    return {name: min(_shares(dict(np.load(folder / f"semantic_{name}.npz")))) for name in SCENES}


def channels_table(shares: dict[str, float]) -> str:
    """Tabulate the shares."""
    return markdown_table(["channels", "cells that agree %"], [[k, f"{100 * v:.1f}"] for k, v in shares.items()])


def _shares(recorded: dict[str, Array]) -> list[float]:
    parameters = json.loads(str(recorded["param_json"]))
    names = [str(name) for name in recorded["channels"]]
    fusions = {"pointcloud_channel_fusions": json.loads(str(recorded["fusions_json"]))}
    channels, _ = read_channels(fusions, tuple(names), parameters.get("average_weight", 0.5), every_point=True)
    known = {key: value for key, value in parameters.items() if key in DEFAULTS}
    cfg = ElevationMapConfig.like_em_cupy(**(known | WITHOUT))
    sensor = dataclasses.replace(cfg.sensor, min_distance=0.0, exclusion=None, depth=None)  # gates are in `_rounded`
    chosen = {name: channels[name] for name in names}
    emap = ElevationMap(dataclasses.replace(cfg, sensor=sensor, channels=chosen))
    starts, shares = np.concatenate([[0], np.cumsum(recorded["npts"])]), []
    for f in range(len(recorded["npts"])):
        part = slice(starts[f], starts[f + 1])
        points, noise = _rounded(recorded, f, part, parameters)
        features = {name: _given(recorded["features"][part, k], name, chosen) for k, name in enumerate(names)}
        seconds = float(recorded["n_update_time"][f]) * parameters["time_interval"]
        one, variance = torch.eye(4, dtype=torch.float64)[None], torch.from_numpy(noise)[None]
        base = one.clone()
        base[0, :3, 3] = torch.from_numpy(recorded["move_to"][f])
        emap.update(torch.from_numpy(points)[None], one, base, dt=seconds, variance=variance, features=features)
        shares += _compare(emap, recorded, f, points, names)
    return shares


def _given(values: Array, name: str, channels: dict[str, Any]) -> torch.Tensor:
    found: Array = _colors(values).T if channels[name].is_color else values[:, None]
    return torch.from_numpy(np.ascontiguousarray(found, dtype=np.float32))[None]


def _colors(packed: Array) -> Array:
    """Return red, green and blue (3, ...) from 0 to 1 of 0xRRGGBB in the bits of a float32."""
    bits = packed.astype(np.float32).view(np.uint32)
    colors: Array = np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)]) / 255
    return colors


def _half(values: Array) -> Array:
    halves: Array = values.astype(np.float16).astype(np.float32)
    return halves


def _rounded(recorded: dict[str, Array], f: int, part: slice, p: dict[str, float]) -> tuple[Array, Array]:
    """Return the points (N, 3) in the map frame as the kernels see them, NaN where they reject them, and variances."""
    center = np.round(recorded["move_to"][f] / p["resolution"]) * p["resolution"]
    center = np.array([*center[:2], recorded["move_to"][f][2]], np.float32)
    origin, sensed = _half(recorded["t"][f] - center), _half(recorded["points"][part])
    points = sensed @ _half(recorded["R"][f]).T + origin
    above, square = points[:, 2] - origin[2], ((points - origin) ** 2).sum(1)
    ramp = np.maximum(np.hypot(points[:, 0], points[:, 1]) - p["ramped_height_range_b"], 0)
    limit = np.minimum(ramp * p["ramped_height_range_a"] + p["ramped_height_range_c"], p["max_height_range"])
    points[:, :2] = _half(points[:, :2])
    points[(square < p["min_valid_distance"] ** 2) | (above > limit)] = np.nan
    return points + center, p["sensor_noise_factor"] * sensed[:, 2] ** 2 + 1e-9


def _compare(emap: ElevationMap, recorded: dict[str, Array], f: int, points: Array, names: list[str]) -> list[float]:
    """Return the share of cells that agree, of each channel."""
    grid, size = emap.cfg.grid, emap.cfg.grid.height + 2  # they have a border of one cell
    rows, columns = recorded["cells"] // size - 1, recorded["cells"] % size - 1
    inside = (rows >= 0) & (columns >= 0) & (rows < grid.height) & (columns < grid.width)
    place = rows.clip(0, grid.height - 1), columns.clip(0, grid.width - 1)
    ij = np.floor(points[np.isfinite(points).all(1), :2] / grid.resolution).astype(int) - emap.state.corner[0].numpy()
    ij = ij[((ij >= 0) & (ij < [grid.height, grid.width])).all(1)]
    number = np.zeros((grid.height, grid.width))
    np.add.at(number, tuple(ij.T), 1)
    whole = inside & (recorded["inserted_count"][f] > 0) & (recorded["inserted_count"][f] == number[place])
    shares = []
    for k, name in enumerate(names):
        is_color = emap.cfg.channels[name].is_color
        theirs = _colors(recorded["semantic"][f, k]) if is_color else recorded["semantic"][f, k][None]
        ours = emap.layer(name)[0].numpy().reshape(-1, grid.height, grid.width)[:, place[0], place[1]]
        agrees = np.abs(ours - theirs).max(0) <= (LEVEL if is_color else TOLERANCE)
        shares.append(float(agrees[whole].mean()))
    return shares
