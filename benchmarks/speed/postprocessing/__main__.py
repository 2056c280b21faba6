"""Time filters and plane segmentation beside the OpenCV or SciPy calls that give the same.

    python -m benchmarks.speed.postprocessing                   # benchmarks/results/postprocessing.json, eight minutes
    python -m benchmarks.speed.postprocessing --seconds 0.3     # quicker, rougher

The maps hold stairs, boxes, noise and holes, in cells of 4 cm. `differs` is the 99th percentile, over known cells, of
the absolute difference between a filter and its OpenCV or SciPy peer [m].
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy.ndimage as ndimage
import torch
from numpy.typing import NDArray

from benchmarks import RESULTS
from benchmarks.speed.common import meter
from benchmarks.speed.postprocessing import peers
from benchmarks.speed.postprocessing.peers import RESOLUTION, Peer
from torchelev import filters, planes
from torchelev.app.results import markdown_table, write_json
from torchelev.layers import Layer
from torchelev.sim.exact import plane_scenes

SIZES = ((1, 200), (1, 250), (1, 512), (256, 64))  # number of maps, cells along each side


def ground(maps: int, cells: int, seed: int = 0) -> Layer:
    """Return steps, boxes and waves with 5 mm of noise, and holes of many sizes that cover a tenth of the map."""
    generator = np.random.default_rng(seed)
    x, y = np.meshgrid(*[np.arange(cells) * RESOLUTION] * 2, indexing="ij")
    heights = np.empty((maps, cells, cells), np.float32)
    for number in range(maps):
        phase = generator.uniform(0, 2 * np.pi, 2)
        heights[number] = 0.15 * np.floor(x / 1.2) * (y < y.max() / 2) + 0.1 * np.sin(x + phase[0]) * np.sin(
            y + phase[1]
        )
        for i, j, size in generator.integers(0, [cells, cells, 12], (cells // 10, 3)):
            heights[number, i : i + size, j : j + size] += 0.3
    heights += generator.normal(0, 0.005, heights.shape).astype(np.float32)
    holes = np.stack([ndimage.gaussian_filter(generator.normal(size=(cells, cells)), 2.0) for _ in range(maps)])
    known = holes > np.quantile(holes, 0.1)
    return torch.from_numpy(np.where(known, heights, 0).astype(np.float32)), torch.from_numpy(known)


class Case(NamedTuple):
    """A filter, the OpenCV or SciPy call to compare with, and whether both give the same."""

    ours: Callable[[Layer], Any]
    peer: Peer | None = None
    same: bool = False


def cases() -> dict[str, Case]:
    """Return the filters by name."""
    formula = filters.Expression("0.5 * (1 - abs(z) / 0.6) + 0.5 * min(z ** 2, 1)")
    telea, navier_stokes = (partial(peers.cv_inpaint, method=m) for m in (cv2.INPAINT_TELEA, cv2.INPAINT_NS))

    def metric(function: Callable[..., Any]) -> Callable[[Layer], Any]:
        return partial(function, resolution=RESOLUTION)

    return {
        "inpaint_minimum": Case(filters.inpaint_minimum, peers.scipy_inpaint_minimum, True),
        "inpaint_nearest": Case(filters.inpaint_nearest, peers.scipy_inpaint_nearest),
        "inpaint_diffusion": Case(filters.inpaint_diffusion),
        "inpaint_telea": Case(metric(filters.inpaint_telea), telea),
        "inpaint_navier_stokes": Case(metric(filters.inpaint_navier_stokes), navier_stokes),
        "gaussian": Case(metric(filters.gaussian), peers.cv_gaussian, True),
        "box": Case(metric(filters.box), peers.cv_box, True),
        "median": Case(metric(filters.median), peers.scipy_median),
        "dilation": Case(metric(filters.dilation), peers.cv_dilation, True),
        "erosion": Case(metric(filters.erosion), peers.cv_erosion, True),
        "step_height": Case(metric(filters.step_height), peers.cv_step, True),
        "standard_deviation": Case(metric(filters.standard_deviation), peers.cv_deviation, True),
        "slope": Case(metric(filters.slope)),
        "roughness": Case(metric(filters.roughness)),
        "curvature": Case(metric(filters.curvature)),
        "signed_distance": Case(metric(filters.signed_distance), peers.cv_distance),
        "expression": Case(lambda layer: formula({"z": layer})),
        "planes": Case(lambda layer: planes.segment(filters.as_nan(layer), RESOLUTION)),
    }


def _on_each(peer: Peer, layer: Layer) -> list[NDArray]:
    """Call a peer on each map of a layer."""
    return [peer(values, known) for values, known in zip(layer[0].numpy(), layer[1].numpy(), strict=True)]


def measure(seconds: float, sizes: Sequence[tuple[int, int]] = SIZES) -> list[dict[str, Any]]:
    """Time every filter and its peer in turn, at every size."""
    rows = []
    for maps, cells in sizes:
        layer = ground(maps, cells)
        for name, (ours, peer, same) in cases().items():
            runs: dict[str, Callable[[], Any]] = {"ours": partial(ours, layer)}
            if peer is not None:
                runs["peer"] = partial(_on_each, peer, layer)
            times = meter.interleaved(runs, seconds)
            row = {"filter": name, "maps": maps, "cells": cells, **times}
            if peer is not None:
                row["ratio"] = times["ours"]["median"] / times["peer"]["median"]
            if same:
                known = layer[1].numpy() if name != "inpaint_minimum" else np.ones(layer[1].shape, bool)
                gap = np.abs(runs["ours"]()[0].numpy() - np.stack(runs["peer"]()))[known]
                row["differs"] = float(np.quantile(gap, 0.99))
            rows.append(row)
            time = f"{times['ours']['median']:8.2f} ms"
            print(f"{name:24s} {maps:4d} x {cells}^2 {time}", row.get("ratio", ""), flush=True)
    return rows


def _measure_planes(seconds: float) -> list[dict[str, Any]]:
    """Time the segmentation of single maps of 250 x 250 cells."""
    elevations = {name: plane_scenes.noisy(scene(RESOLUTION)) for name, scene in plane_scenes.SCENES.items()}
    runs = {name: partial(planes.segment, z, RESOLUTION) for name, z in elevations.items()}
    times = meter.interleaved(runs, seconds)
    return [{"scene": name, "regions": len(runs[name]()[0].regions)} | times[name] for name in runs]


def planes_table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the times of plane segmentation."""
    lines = [[r["scene"], str(r["regions"]), f"{r['median']:.1f}", f"{r['min']:.1f}"] for r in rows]
    return markdown_table(["planes of 250 x 250 cells", "regions", "median ms", "min ms"], lines)


def table(rows: list[dict[str, Any]], sizes: Sequence[tuple[int, int]] = SIZES) -> str:
    """Tabulate the median times [ms], with the ratio to the peer in brackets."""
    found = {(row["filter"], row["maps"], row["cells"]): row for row in rows}
    head = ["ms (ratio to OpenCV or SciPy)", *(f"{maps} x {cells} x {cells}" for maps, cells in sizes)]
    lines = []
    for name in dict.fromkeys(row["filter"] for row in rows):
        cells = [found[(name, *size)] for size in sizes]
        times = [f"{c['ours']['median']:.2f}" + (f" ({c['ratio']:.2f})" if "ratio" in c else "") for c in cells]
        lines.append([name, *times])
    return markdown_table(head, lines)


def main() -> None:
    """Measure, write JSON and print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed.postprocessing",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    seconds_help = "time per filter, peer and size [s] (default: %(default)s)"
    parser.add_argument("--seconds", type=float, default=2.0, help=seconds_help)
    path = RESULTS / "postprocessing.json"
    parser.add_argument(
        "--out", type=Path, default=path, help="JSON file (default: benchmarks/results/postprocessing.json)"
    )
    options = parser.parse_args()
    rows, scenes = measure(options.seconds), _measure_planes(options.seconds)
    write_json(options.out, {"resolution": RESOLUTION, "rows": rows, "planes": scenes})
    print(f"{table(rows)}\n\n{planes_table(scenes)}")


if __name__ == "__main__":
    main()
