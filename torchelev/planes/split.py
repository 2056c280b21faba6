"""From cells that lie on planes to planar regions: components that are not planar are cut until they are."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from torchelev.planes.fits import Limits
from torchelev.planes.lattice import components, same
from torchelev.planes.sums import (
    RegionPlanes,
    Runs,
    Surface,
    distances,
    find_runs,
    fit_planes,
    region_moments,
    region_sums,
    rimmed,
    running_sums,
)

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

MAX_CUTS = 20  # each of which halves what is left
BINS = 64  # of a histogram over 8 standard deviations
MIN_PIECE = 4  # [cells] smaller pieces of a cut are crumbs, which growing gives to a neighbour


def split(labels: Int[ndarray, "P"], surface: Surface, limits: Limits) -> tuple[Int[ndarray, "P"], RegionPlanes]:
    """Cut components until each is planar. Returns labels and planes.

    Where the cells of a region are rougher than allowed it is cut in two; where it is planar but for some cells, these
    leave it. What hangs together in each part is a region of the next round. What MAX_CUTS rounds leave is dropped.
    """
    final, planes, count = np.full(labels.size, -1, np.int64), [], 0
    cutter = Cutter(labels >= 0, surface, limits)
    for _ in range(MAX_CUTS):
        runs, number = find_runs(labels), int(labels.max()) + 1
        plane = fit_planes(region_moments(surface, runs, number), None, surface.weight)
        cell = np.flatnonzero(labels >= 0)
        region = labels[cell]
        distance = distances(surface, cell, plane.forms()[region])
        planar = plane.roughness <= limits.roughness
        stays = planar[region] & (np.abs(distance) <= limits.distance)
        final[cell[stays]] = count + region[stays]
        planes.append(plane)
        count += number
        cell, region, distance = cell[~stays], region[~stays], distance[~stays]
        upper = distance > 0  # of cells that leave a planar region
        if not planar.all():
            upper = np.where(planar[region], upper, cutter.upper(runs, cell, region, distance, plane))
        labels = _pieces(surface.shape, cell, 2 * region + upper)
        if labels.max() < 0:
            break
    return final, RegionPlanes(*(np.concatenate(values) for values in zip(*planes, strict=True)))


def _pieces(shape: tuple[int, int], cell: Int[ndarray, "N"], part: Int[ndarray, "N"]) -> Int[ndarray, "P"]:
    """Label what hangs together in each part, but for crumbs."""
    image = np.full((shape[0] + 1, shape[1] + 1), -1, np.int64)
    image.ravel()[cell] = part
    labels, number = components(*same(image[:-1, :-1]))
    large = np.bincount(labels.ravel() + 1, minlength=number + 1) >= MIN_PIECE
    large[0] = False
    rank = np.where(large, np.cumsum(large) - 1, -1)
    return rimmed(rank[labels + 1], -1).ravel()


class Cutter:
    """Where to cut regions in two."""

    def __init__(self, planar: Bool[ndarray, "P"], surface: Surface, limits: Limits) -> None:
        self.planar, self.surface = planar, surface
        # More than noise of the allowed roughness leaves in the mean gradient of many windows.
        self.least_spread = (limits.roughness / (8 * surface.radius * surface.resolution)) ** 2

    @cached_property
    def gradient(self) -> tuple[Float[ndarray, "P"], Float[ndarray, "P"]]:
        """The gradients, each the mean over the planar cells of a window of twice the size: cuts follow their noise."""
        import cv2

        size = 4 * self.surface.radius + 1
        shape = self.surface.shape[0] + 1, self.surface.shape[1] + 1

        def total(values: ndarray) -> ndarray:
            border = cv2.BORDER_CONSTANT
            return cv2.boxFilter(values.reshape(shape), cv2.CV_64F, (size, size), normalize=False, borderType=border)

        weight = self.planar.astype(np.float64)
        number = total(weight).clip(min=0.5)
        gx, gy = (total(g * weight) / number for g in (self.surface.gradient_x, self.surface.gradient_y))
        return gx.ravel(), gy.ravel()

    @cached_property
    def before(self) -> Float[ndarray, "5 P"]:
        """Running sums of the gradients and their products."""
        gx, gy = self.gradient
        return running_sums([gx, gy, gx * gx, gx * gy, gy * gy], self.surface.shape[1])

    def upper(
        self,
        runs: Runs,
        cell: Int[ndarray, "N"],
        region: Int[ndarray, "N"],
        distance: Float[ndarray, "N"],
        plane: RegionPlanes,
    ) -> Bool[ndarray, "N"]:
        """Tell which cells lie in the upper part of their region, cut where each part varies least (Otsu).

        By the gradient along its main axis, where its spread over the region's extent could make the roughness that
        is there; else, as for two parallel planes, by the distance from the region's plane.
        """
        axis, offset, spread = self._main_axis(runs, plane.number)
        bent = (spread > self.least_spread) & (spread * plane.extent > plane.roughness**2)
        scale = np.where(bent, np.sqrt(spread), plane.roughness)
        step = np.divide(BINS / 8, scale, out=np.zeros_like(scale), where=scale > 0)
        gx, gy = (g[cell] for g in self.gradient)
        along = axis[0][region] * gx + axis[1][region] * gy - offset[region]
        value = np.where(bent[region], along, distance) * step[region] + BINS / 2
        bins = value.clip(0, BINS - 1).astype(np.int64)
        histogram = np.bincount(region * BINS + bins, minlength=len(scale) * BINS).reshape(-1, BINS)
        return bins > _otsu(histogram)[region]

    def _main_axis(self, runs: Runs, number: Float[ndarray, "K"]) -> tuple[ndarray, ndarray, ndarray]:
        """Return the direction in which the gradients of each region spread most, their mean and variance along it."""
        sums = region_sums(self.before, runs, len(number)) / number.clip(min=1)
        mx, my, xx, xy, yy = sums
        xx, xy, yy = xx - mx * mx, xy - mx * my, yy - my * my
        angle = np.arctan2(2 * xy, xx - yy) / 2
        axis = np.stack([np.cos(angle), np.sin(angle)])
        return axis, axis[0] * mx + axis[1] * my, ((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)).clip(min=0)


def _otsu(histogram: Int[ndarray, "K BINS"]) -> Int[ndarray, "K"]:
    """Return the last bin of each lower part; the parts differ most in their means."""
    below = np.cumsum(histogram, 1)
    total = below[:, -1:]
    moment = np.cumsum(histogram * np.arange(BINS), 1)
    between = (moment[:, -1:] * below - moment * total).astype(np.float64) ** 2
    return np.argmax(between / (below * (total - below)).clip(min=1), 1)
