"""Components of planar cells become planar regions: those that are not planar are cut until they are."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from torchelev.planes.lattice import components, same_label
from torchelev.planes.local_planes import Limits
from torchelev.planes.region_planes import RegionPlanes, distances, fit_planes
from torchelev.planes.sums import Runs, Surface, cumulative_sums, find_runs, pad_cells, region_moments, region_sums

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

MAX_CUTS = 20  # rounds, each of which halves the regions that are not planar
BINS = 64  # of a histogram over 8 standard deviations
_MIN_CELLS = 4  # smaller pieces of a cut are dropped; growing gives their cells to a neighbour


def split(labels: Int[ndarray, "P"], surface: Surface, limits: Limits) -> tuple[Int[ndarray, "P"], RegionPlanes]:
    """Cut components until each is planar; return labels and planes.

    A region rougher than allowed is cut in two; from a planar one only the cells too far from its plane are removed.
    The connected pieces are the regions of the next round. What is left after MAX_CUTS rounds is dropped.
    """
    final, planes, count = np.full(labels.size, -1, np.int64), [], 0
    cutter = _Cutter(labels >= 0, surface, limits)
    for _ in range(MAX_CUTS):
        runs, number = find_runs(labels), int(labels.max()) + 1
        plane = fit_planes(region_moments(surface, runs, number), None, surface.window_moment)
        cell = np.flatnonzero(labels >= 0)
        region = labels[cell]
        distance = distances(surface, cell, plane.distance_weights()[region])
        is_planar = plane.roughness <= limits.roughness
        stays = is_planar[region] & (np.abs(distance) <= limits.distance)
        final[cell[stays]] = count + region[stays]
        planes.append(plane)
        count += number
        cell, region, distance = cell[~stays], region[~stays], distance[~stays]
        if len(cell) < _MIN_CELLS:
            break
        is_upper = distance > 0  # of cells removed from a planar region
        if not is_planar.all():
            is_upper = np.where(is_planar[region], is_upper, cutter.upper_part(runs, cell, region, distance, plane))
        labels = label_pieces(surface.shape, cell, 2 * region + is_upper)
        if labels.max() < 0:
            break
    return final, RegionPlanes(*(np.concatenate(values) for values in zip(*planes, strict=True)))


def label_pieces(shape: tuple[int, int], cell: Int[ndarray, "N"], part: Int[ndarray, "N"]) -> Int[ndarray, "P"]:
    """Label the connected pieces of each part that have at least _MIN_CELLS cells."""
    image = np.full((shape[0] + 1, shape[1] + 1), -1, np.int64)
    image.ravel()[cell] = part
    labels, number = components(*same_label(image[:-1, :-1]))
    is_large = np.bincount(labels.ravel() + 1, minlength=number + 1) >= _MIN_CELLS
    is_large[0] = False
    rank = np.where(is_large, np.cumsum(is_large) - 1, -1)
    return pad_cells(rank[labels + 1], -1).ravel()


class _Cutter:
    """Decides where regions are cut in two."""

    def __init__(self, is_planar: Bool[ndarray, "P"], surface: Surface, limits: Limits) -> None:
        self.is_planar, self.surface = is_planar, surface
        # Larger than the noise of the allowed roughness in a mean over many windows' gradients.
        self.min_spread = (limits.roughness / (8 * surface.radius * surface.resolution)) ** 2

    @cached_property
    def gradient(self) -> tuple[Float[ndarray, "P"], Float[ndarray, "P"]]:
        """The mean gradient of the planar cells in a window twice as large: a cut would follow single cells' noise."""
        import cv2

        size = 4 * self.surface.radius + 1
        shape = self.surface.num_maps, -1, self.surface.shape[1] + 1

        def window_sum(values: ndarray) -> ndarray:
            # OpenCV's running sums take the same time for windows of any size. They may not reach another map.
            border, sums = cv2.BORDER_CONSTANT, np.empty_like(values)
            for one, result in zip(values.reshape(shape), sums.reshape(shape), strict=True):
                cv2.boxFilter(one, cv2.CV_64F, (size, size), dst=result, normalize=False, borderType=border)
            return sums

        weight = self.is_planar.astype(np.float64)
        number = window_sum(weight).clip(min=0.5)
        gx, gy = (window_sum(g * weight) / number for g in (self.surface.gradient_x, self.surface.gradient_y))
        return gx, gy

    @cached_property
    def before(self) -> Float[ndarray, "5 P"]:
        """Cumulative sums of the gradients and their products."""
        gx, gy = self.gradient
        return cumulative_sums([gx, gy, gx * gx, gx * gy, gy * gy], self.surface.shape[1])

    def upper_part(
        self,
        runs: Runs,
        cell: Int[ndarray, "N"],
        region: Int[ndarray, "N"],
        distance: Float[ndarray, "N"],
        plane: RegionPlanes,
    ) -> Bool[ndarray, "N"]:
        """Return which cells lie in the upper part of their region, cut where the parts vary least (Otsu).

        The cut is by the gradient along its main axis if its spread over the region's extent can explain the region's
        roughness; else, as for two parallel planes, by the distance from the region's plane.
        """
        axis, offset, spread = self._main_axis(runs, plane.number)
        is_bent = (spread > self.min_spread) & (spread * plane.extent > plane.roughness**2)
        scale = np.where(is_bent, np.sqrt(spread), plane.roughness)
        bins_per_unit = np.divide(BINS / 8, scale, out=np.zeros_like(scale), where=scale > 0)
        gx, gy = (g[cell] for g in self.gradient)
        along = axis[0][region] * gx + axis[1][region] * gy - offset[region]
        value = np.where(is_bent[region], along, distance) * bins_per_unit[region] + BINS / 2
        bins = value.clip(0, BINS - 1).astype(np.int64)
        histogram = np.bincount(region * BINS + bins, minlength=len(scale) * BINS).reshape(-1, BINS)
        return bins > otsu_thresholds(histogram)[region]

    def _main_axis(self, runs: Runs, number: Float[ndarray, "K"]) -> tuple[ndarray, ndarray, ndarray]:
        """Return the direction in which each region's gradients spread most, and their mean and variance along it."""
        sums = region_sums(self.before, runs, len(number)) / number.clip(min=1)
        mx, my, xx, xy, yy = sums
        xx, xy, yy = xx - mx * mx, xy - mx * my, yy - my * my
        angle = np.arctan2(2 * xy, xx - yy) / 2
        axis = np.stack([np.cos(angle), np.sin(angle)])
        return axis, axis[0] * mx + axis[1] * my, ((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)).clip(min=0)


def otsu_thresholds(histogram: Int[ndarray, "K BINS"]) -> Int[ndarray, "K"]:
    """Return the last bin of each histogram's lower part, by Otsu's method: the variance between parts is largest."""
    below = np.cumsum(histogram, 1)
    total = below[:, -1:]
    moment = np.cumsum(histogram * np.arange(BINS), 1)
    between = (moment[:, -1:] * below - moment * total).astype(np.float64) ** 2
    return np.argmax(between / (below * (total - below)).clip(min=1), 1)
