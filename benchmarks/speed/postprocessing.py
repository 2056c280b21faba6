"""How long filters and planes take, beside the OpenCV or SciPy calls that give the same.

    python -m benchmarks.speed.postprocessing                   # benchmarks/results/postprocessing.json, eight minutes
    python -m benchmarks.speed.postprocessing --seconds 0.3     # quicker, rougher

Maps of stairs, boxes and noise with holes, 4 cm cells. A peer gets NumPy arrays and returns what our filter returns,
on known cells: where OpenCV knows no masks, it smooths values and mask and divides. `differs` is the 99th percentile of
the difference [m].
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import scipy.ndimage as ndimage
import torch
from numpy.typing import NDArray

from benchmarks.speed import meter
from torchelev import filters, planes
from torchelev.app.results import markdown_table, write_json
from torchelev.layers import Layer
from torchelev.sim.exact import plane_scenes

RESOLUTION = 0.04  # [m]
SIZES = ((1, 200), (1, 250), (1, 512), (256, 64))  # maps, cells along a side
Peer = Callable[[NDArray, NDArray], NDArray]  # values (H, W) float32, 0 where unknown, and known (H, W) -> (H, W)


def ground(maps: int, cells: int, seed: int = 0) -> Layer:
    """Return steps, boxes and waves with 5 mm of noise, and holes of many sizes: a tenth is unknown."""
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


# What gives the same by OpenCV or SciPy -----------------------------------------------------------------------------


def masked_mean(values: NDArray, known: NDArray, blur: Callable[[NDArray], NDArray]) -> NDArray:
    """Blur values and mask, and divide."""
    return blur(values) / np.maximum(blur(known.astype(np.float32)), 1e-6)


def cv_gaussian(values: NDArray, known: NDArray) -> NDArray:
    """The default sigma, 0.1 m, up to three of them."""
    width = 2 * round(0.3 / RESOLUTION) + 1
    blur = functools.partial(
        cv2.GaussianBlur, ksize=(width, width), sigmaX=0.1 / RESOLUTION, borderType=cv2.BORDER_CONSTANT
    )
    return masked_mean(values, known, blur)


def cv_box(values: NDArray, known: NDArray) -> NDArray:
    """Windows of 5 x 5."""
    return masked_mean(values, known, lambda v: cv2.blur(v, (5, 5), borderType=cv2.BORDER_CONSTANT))


def scipy_median(values: NDArray, known: NDArray) -> NDArray:
    """Windows of 3 x 3, unknown cells too: no library's median knows masks."""
    return ndimage.median_filter(values, 3)


def cv_dilation(values: NDArray, known: NDArray) -> NDArray:
    """Windows of 5 x 5; unknown is lowest."""
    return cv2.dilate(np.where(known, values, np.float32(-1e9)), np.ones((5, 5), np.uint8))


def cv_erosion(values: NDArray, known: NDArray) -> NDArray:
    """Windows of 5 x 5; unknown is highest."""
    return cv2.erode(np.where(known, values, np.float32(1e9)), np.ones((5, 5), np.uint8))


def cv_step(values: NDArray, known: NDArray) -> NDArray:
    """Highest less lowest."""
    return cv_dilation(values, known) - cv_erosion(values, known)


def cv_deviation(values: NDArray, known: NDArray) -> NDArray:
    """Means of values and of squares."""
    number = np.maximum(cv2.blur(known.astype(np.float32), (5, 5), borderType=cv2.BORDER_CONSTANT), 1e-6)
    mean = cv2.blur(values, (5, 5), borderType=cv2.BORDER_CONSTANT) / number
    square = cv2.blur(values * values, (5, 5), borderType=cv2.BORDER_CONSTANT) / number
    return np.sqrt(np.maximum(square - mean * mean, 0))


def scipy_inpaint_minimum(values: NDArray, known: NDArray) -> NDArray:
    """The lowest border cell of each hole, by labels."""
    labels, count = ndimage.label(~known, np.ones((3, 3)))
    if not count:
        return values
    lowest = ndimage.grey_erosion(np.where(known, values, 1e9), size=(3, 3))
    filling = ndimage.minimum(lowest, labels, np.arange(count + 1))
    return np.where(known, values, filling[labels])


def scipy_inpaint_nearest(values: NDArray, known: NDArray) -> NDArray:
    """The index of the nearest known cell."""
    i, j = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[i, j]


def cv_inpaint(values: NDArray, known: NDArray, method: int) -> NDArray:
    """OpenCV's own, on 16 bits: to the millimetre."""
    low = values.min()
    millimetres = np.round((values - low) * 1000).astype(np.uint16)
    return cv2.inpaint(millimetres, (~known).astype(np.uint8), 5, method) / 1000 + low


def cv_distance(values: NDArray, known: NDArray) -> NDArray:
    """The distance to the nearest step of 0.1 m or unknown cell, without half cells."""
    edge = ~known | (cv2.dilate(values, np.ones((3, 3))) - cv2.erode(values, np.ones((3, 3))) > 0.1)
    return cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * RESOLUTION


def cases() -> dict[str, tuple[Callable[[Layer], Any], Peer | None, bool]]:
    """Return each filter, its peer, and whether both give the same."""
    at = {"resolution": RESOLUTION}
    formula = filters.Expression("0.5 * (1 - abs(z) / 0.6) + 0.5 * min(z ** 2, 1)")
    telea, stokes = (functools.partial(cv_inpaint, method=m) for m in (cv2.INPAINT_TELEA, cv2.INPAINT_NS))
    ours: dict[str, tuple[Callable[[Layer], Any], Peer | None, bool]] = {
        "inpaint_minimum": (filters.inpaint_minimum, scipy_inpaint_minimum, True),
        "inpaint_nearest": (filters.inpaint_nearest, scipy_inpaint_nearest, False),
        "inpaint_diffusion": (filters.inpaint_diffusion, None, False),
        "inpaint_telea": (lambda z: filters.inpaint_telea(z, **at), telea, False),
        "inpaint_navier_stokes": (lambda z: filters.inpaint_navier_stokes(z, **at), stokes, False),
        "gaussian": (lambda z: filters.gaussian(z, **at), cv_gaussian, True),
        "box": (lambda z: filters.box(z, **at), cv_box, True),
        "median": (lambda z: filters.median(z, **at), scipy_median, False),
        "dilation": (lambda z: filters.dilation(z, **at), cv_dilation, True),
        "erosion": (lambda z: filters.erosion(z, **at), cv_erosion, True),
        "step_height": (lambda z: filters.step_height(z, **at), cv_step, True),
        "standard_deviation": (lambda z: filters.standard_deviation(z, **at), cv_deviation, True),
        "slope": (lambda z: filters.slope(z, **at), None, False),
        "roughness": (lambda z: filters.roughness(z, **at), None, False),
        "curvature": (lambda z: filters.curvature(z, **at), None, False),
        "signed_distance": (lambda z: filters.signed_distance(z, **at), cv_distance, False),
        "expression": (lambda z: formula({"z": z}), None, False),
        "planes": (lambda z: planes.segment(filters.as_nan(z), RESOLUTION), None, False),
    }
    return ours


def measure(seconds: float) -> list[dict[str, Any]]:
    """Time every filter and its peer in turn, at every size."""
    rows = []
    for maps, cells in SIZES:
        layer = ground(maps, cells)
        arrays = list(zip(layer[0].numpy(), layer[1].numpy(), strict=True))
        for name, (ours, peer, same) in cases().items():
            runs: dict[str, Callable[[], Any]] = {"ours": lambda run=ours, z=layer: run(z)}
            if peer is not None:
                runs["peer"] = lambda run=peer, a=arrays: [run(values, known) for values, known in a]
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


def measure_planes(seconds: float) -> list[dict[str, Any]]:
    """Time the segmentation of single maps of 250 x 250 cells."""
    elevations = {name: plane_scenes.noisy(scene(RESOLUTION)) for name, scene in plane_scenes.SCENES.items()}
    runs = {name: lambda z=z: planes.segment(z, RESOLUTION) for name, z in elevations.items()}
    times = meter.interleaved(runs, seconds)
    return [{"scene": name, "regions": len(runs[name]()[0].regions)} | times[name] for name in runs]


def planes_table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the times of planes."""
    lines = [[r["scene"], str(r["regions"]), f"{r['median']:.1f}", f"{r['min']:.1f}"] for r in rows]
    return markdown_table(["planes of 250 x 250 cells", "regions", "median ms", "min ms"], lines)


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate medians, and the ratio to the peer in brackets."""
    found = {(row["filter"], row["maps"], row["cells"]): row for row in rows}
    head = ["ms (ratio to OpenCV or SciPy)", *(f"{maps} x {cells} x {cells}" for maps, cells in SIZES)]
    lines = []
    for name in dict.fromkeys(row["filter"] for row in rows):
        cells = [found[(name, *size)] for size in SIZES]
        times = [f"{c['ours']['median']:.2f}" + (f" ({c['ratio']:.2f})" if "ratio" in c else "") for c in cells]
        lines.append([name, *times])
    return markdown_table(head, lines)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="for each filter, peer and size")
    parser.add_argument("--out", default="benchmarks/results/postprocessing.json")
    options = parser.parse_args()
    rows, scenes = measure(options.seconds), measure_planes(options.seconds)
    write_json(options.out, {"resolution": RESOLUTION, "rows": rows, "planes": scenes})
    print(f"{table(rows)}\n\n{planes_table(scenes)}")


if __name__ == "__main__":
    main()
