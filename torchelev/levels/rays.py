"""What the rays of a scan passed through: the nearest return of each direction, and the highest ray over each cell.

All rays of a sensor share an origin, so a direction is free up to its nearest return. Directions are bins of azimuth
and elevation; a place is free only if all returns of the bins that cover it lie farther.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.stages.visibility.polar_table import azimuth_fraction

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

MARGIN = 1.5  # [cells] behind a place that a ray must reach
NEAREST = 3.0  # [cells] from the sensor, below which directions cover too much
RISE = 0.5  # [cells] by which free space must grow to be looked at
MAX_WINDOW = 8  # [bins] of azimuth on either side of a place


class SightGrid(NamedTuple):
    """Size of the tables of one sensor."""

    azimuths: int  #: A, bins around the sensor
    elevations: int  #: E, bins from straight down to straight up
    ranges: int  #: R, bins of one cell along a ray; the last one stays blank, for what lies out of reach
    resolution: float  #: [m] of the map

    @classmethod
    def of(cls, grid: GridConfig) -> SightGrid:
        """Choose bins as wide as a cell at half the reach of the window."""
        cells = max(grid.height, grid.width)
        azimuths = min(1024, max(64, 2 ** math.ceil(math.log2(math.pi * cells / 2))))
        reach = math.ceil(0.75 * math.hypot(grid.height, grid.width)) + 4  # the sensor is near the middle
        return cls(azimuths, azimuths // 4, reach, grid.resolution)


class Sight(NamedTuple):
    """What the rays of one sensor saw."""

    origin: Float[Tensor, "B 3"]  #: [m] of the sensor, from the measurement's anchor
    nearest: Float[Tensor, "B EA"]  #: [m] horizontal range of the nearest return of each direction; inf: none
    highest: Float[Tensor, "B RA"]  #: greatest slope of the rays that end at or beyond each range; -inf: none
    lowest: Float[Tensor, "B RA"]  #: least slope of these; inf: none


def azimuth_bin(x: Tensor, y: Tensor, size: SightGrid) -> Int[Tensor, "..."]:
    """Return the azimuth bins of directions."""
    return (azimuth_fraction(x, y) * size.azimuths).to(torch.int64).clamp(0, size.azimuths - 1)


def elevation_bin(rho: Tensor, dz: Tensor, size: SightGrid) -> Int[Tensor, "..."]:
    """Return the bins of elevation, (1 + dz / (rho + |dz|)) / 2 in [0, 1]: monotonic, and without an arc tangent."""
    fraction = 0.5 + 0.5 * (dz / (rho + dz.abs()).clamp(min=1e-12))
    return (fraction * size.elevations).to(torch.int64).clamp(0, size.elevations - 1)


def horizontal(x: Tensor, y: Tensor) -> Tensor:
    """Return the horizontal distance."""
    return (x * x + y * y).sqrt()


def look(points: Float[Tensor, "B M 3"], casts: Bool[Tensor, "B M"], origin: Tensor, size: SightGrid) -> Sight:
    """Return what the rays to some points of one sensor saw.

    Args:
        points: ends of the rays [m], from the measurement's anchor.
        casts: which of them count.
        origin: of the sensor (B, 3) [m].
        size: of the tables.
    """
    x, y, z = (points - origin[:, None]).unbind(-1)
    rho, A = horizontal(x, y), size.azimuths
    azimuth = azimuth_bin(x, y, size)
    direction = elevation_bin(rho, z, size) * A + azimuth
    nearest = rho.new_full((len(rho), size.elevations * A), torch.inf)
    nearest = nearest.scatter_reduce(1, direction, torch.where(casts, rho, torch.inf), "amin")
    reached = (rho / size.resolution).to(torch.int64).clamp(max=size.ranges - 2) * A + azimuth
    slope, counts = z / rho.clamp(min=1e-12), casts & (rho > 0)
    highest = _beyond(torch.where(counts, slope, -torch.inf), reached, size)
    lowest = -_beyond(torch.where(counts, -slope, -torch.inf), reached, size)
    return Sight(origin, nearest, highest, lowest)


def _beyond(values: Tensor, place: Tensor, size: SightGrid) -> Tensor:
    """Return the greatest value at or beyond each range, (B, R A)."""
    table = values.new_full((len(values), size.ranges * size.azimuths), -torch.inf)
    table = table.scatter_reduce(1, place, values, "amax").unflatten(1, (size.ranges, size.azimuths))
    return table.flip(1).cummax(1).values.flip(1).flatten(1)


def nearest_around(sight: Sight, x: Tensor, y: Tensor, z: Tensor, size: SightGrid) -> tuple[Tensor, Tensor]:
    """Return the nearest return [m] in the directions that cover a cell at some height, and its distance [m].

    Args:
        sight: of one sensor.
        x: centre of the cell (B, Q) [m], as `origin`.
        y: centre of the cell (B, Q) [m].
        z: height of the place (B, Q) [m].
        size: of the tables.

    Returns:
        The range, inf where no ray went there, and the horizontal distance of the cell.
    """
    dx, dy, dz = (value - origin for value, origin in zip((x, y, z), sight.origin[:, :, None].unbind(1), strict=True))
    d, A = horizontal(dx, dy), size.azimuths
    azimuth, row = azimuth_bin(dx, dy, size), elevation_bin(d, dz, size) * A
    half = (0.75 * size.resolution * A / (2 * math.pi)) / d.clamp(min=size.resolution)
    window = half.ceil().clamp(max=MAX_WINDOW)
    found = torch.full_like(d, torch.inf)
    for k in range(-MAX_WINDOW, MAX_WINDOW + 1):
        value = sight.nearest.gather(1, row + (azimuth + k) % A)
        found = torch.where(window >= abs(k), torch.minimum(found, value), found)
    return found, d


def is_free(sight: Sight, x: Tensor, y: Tensor, z: Tensor, size: SightGrid) -> Bool[Tensor, "B Q"]:
    """Return whether rays passed through a cell at some height, and none ended there; arguments as above."""
    found, d = nearest_around(sight, x, y, z, size)
    return (found < torch.inf) & (found >= d + MARGIN * size.resolution) & (d >= NEAREST * size.resolution)


HEIGHTS = (0.3, 0.5, 0.7)  # parts of the gap below a surface at which rays are looked for


class RayHeights(NamedTuple):
    """The rays over each cell: those that end more than a cell behind it."""

    highest: Float[Tensor, "B cells"]  #: [m] -inf: none
    lowest: Float[Tensor, "B cells"]  #: [m] inf: none


class Over(NamedTuple):
    """The directions in which cells lie for one sensor."""

    d: Float[Tensor, "B cells"]  #: [m] horizontal distance
    z: Float[Tensor, "B 1"]  #: [m] height of the sensor
    azimuth: Int[Tensor, "B cells"]  #: bin
    place: Int[Tensor, "B cells"]  #: entry of the rays that end more than a cell behind, in `highest` and `lowest`

    def highest(self, sight: Sight) -> Float[Tensor, "B cells"]:
        """Return the height of the highest ray over each cell [m]; -inf: none."""
        return self.z + (sight.highest.gather(1, self.place) * self.d).nan_to_num(-torch.inf, torch.inf, -torch.inf)

    def lowest(self, sight: Sight) -> Float[Tensor, "B cells"]:
        """Return the height of the lowest ray over each cell [m]; inf: none."""
        return self.z + (sight.lowest.gather(1, self.place) * self.d).nan_to_num(torch.inf, torch.inf, -torch.inf)


def look_over(sight: Sight, x: Tensor, y: Tensor, size: SightGrid) -> Over:
    """Return in which directions of a sensor cells with these centres (B, cells) [m] lie."""
    dx, dy = x - sight.origin[:, 0, None], y - sight.origin[:, 1, None]
    d, azimuth = horizontal(dx, dy), azimuth_bin(dx, dy, size)
    row = (d / size.resolution + MARGIN).to(torch.int64).clamp(max=size.ranges - 1)
    return Over(d, sight.origin[:, 2, None], azimuth, row * size.azimuths + azimuth)


def ray_heights(sights: list[Sight], x: Tensor, y: Tensor, size: SightGrid) -> RayHeights:
    """Return the heights of the highest and the lowest ray over cells with these centres (B, cells) [m]."""
    highest, lowest = torch.full_like(x, -torch.inf), torch.full_like(x, torch.inf)
    for sight in sights:
        over = look_over(sight, x, y, size)
        highest, lowest = torch.maximum(highest, over.highest(sight)), torch.minimum(lowest, over.lowest(sight))
    return RayHeights(highest, lowest)


def height_of(elevation: int, d: Tensor, size: SightGrid) -> Tensor:
    """Return the least height of a bin of elevation above the sensor, at some distance [m]."""
    t = 2 * elevation / size.elevations - 1
    return t / (1 - abs(t)) * d if abs(t) < 1 else torch.full_like(d, math.copysign(math.inf, t))


def raise_free_top(
    free_top: Tensor, floor: Tensor, sights: list[Sight], x: Tensor, y: Tensor, min_gap: float, size: SightGrid
) -> Float[Tensor, "B cells"]:
    """Return up to which height the space above a floor is free, where rays show that it is more than was known [m].

    That is the highest ray that passes the cell, or below it the lowest direction in which a ray ends before the cell:
    rays over a beam say nothing of the space below it. Directions count from half of `min_gap` above the floor, or from
    what was known.

    Args:
        free_top: known before (B, cells) [m]; -inf: nothing.
        floor: (B, cells) [m] of known ground, else the lowest point or ray; inf: nothing is raised.
        sights: what the rays of each sensor saw.
        x: centres of the cells (B, cells) [m].
        y: centres of the cells (B, cells) [m].
        min_gap: [m] of the levels.
        size: of the tables.
    """
    for sight in sights:
        over = look_over(sight, x, y, size)
        d, z, highest = over.d, over.z, over.highest(sight)
        begin = torch.maximum(free_top, floor + 0.5 * min_gap)
        rises = highest > torch.maximum(free_top, floor) + RISE * size.resolution
        first, last = (elevation_bin(d, h - z, size) for h in (begin, torch.maximum(begin, highest)))
        limit, behind = highest.clone(), d + MARGIN * size.resolution
        for e in reversed(range(size.elevations)):
            ends = sight.nearest[:, e * size.azimuths :].gather(1, over.azimuth) < behind
            ends = ends & (first <= e) & (e <= last)
            limit = torch.where(ends, torch.minimum(highest, z + height_of(e, d, size)), limit)
        free_top = torch.where(rises, torch.maximum(free_top, limit), free_top)
    return free_top


def floats(
    sights: list[Sight], x: Tensor, y: Tensor, top: Tensor, lowest: Tensor, min_gap: float, size: SightGrid
) -> Bool[Tensor, "B Q"]:
    """Return whether rays passed below a surface at height `top` (B, Q) [m] over a cell: it hangs free.

    The lowest ray over the cell passes below it, and in the directions of the space below it no ray ends before.
    """
    found = torch.zeros_like(top, dtype=torch.bool)
    for sight in sights:
        for part in HEIGHTS:
            found = found | is_free(sight, x, y, top - part * min_gap, size)
    return found & (lowest < top - HEIGHTS[0] * min_gap)
