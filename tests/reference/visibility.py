"""Rays, and the visibility clean-up."""

import math

import numpy as np

from tests.reference.places import cell_of, center_of


def march(rays, corner, resolution, shape, steps_per_cell=4):
    """The lowest ray over each cell, by marching along every ray: heights (H, W), inf where none, and its direction.

    `rays` are (origin, hit) pairs. A ray counts up to one cell before its hit.
    """
    lowest, direction = np.full(shape, math.inf), np.zeros((*shape, 3))
    for origin, hit in rays:
        horizontal = math.hypot(hit[0] - origin[0], hit[1] - origin[1])
        unit = (hit - origin) / np.linalg.norm(hit - origin)
        for k in range(int((horizontal - resolution) / resolution * steps_per_cell)):
            x, y, z = origin + (k + 0.5) / steps_per_cell * resolution / horizontal * (hit - origin)
            cell = cell_of(x, y, corner, resolution, shape)
            if cell is not None and z < lowest[cell]:
                lowest[cell], direction[cell] = z, unit
    return lowest, direction


def over_centers(lowest, direction, origin, corner, resolution):
    """The heights over the cells' centres of the rays that are lowest in them."""
    height = lowest.copy()
    for i, j in zip(*np.nonzero(np.isfinite(lowest)), strict=True):
        x, y = center_of(i, j, corner, resolution)
        slope = direction[i, j][2] / math.hypot(direction[i, j][0], direction[i, j][1])
        height[i, j] = origin[2] + slope * math.hypot(x - origin[0], y - origin[1])
    return height


def well_supported(c, layers, resolution, min_support):
    """Whether enough points agree with a known cell, or with a known neighbour at a side, less than a cell higher."""

    def enough(a):
        return layers["validity"][a] and layers["support"][a] >= min_support

    H, W = layers["validity"].shape
    around = [(c[0] - 1, c[1]), (c[0] + 1, c[1]), (c[0], c[1] - 1), (c[0], c[1] + 1)]
    around = [a for a in around if 0 <= a[0] < H and 0 <= a[1] < W]
    like = [a for a in around if abs(layers["elevation"][a] - layers["elevation"][c]) <= resolution]
    return bool(layers["validity"][c]) and any(enough(a) for a in [c, *like])


def believed_slope(origin, hit, layers, corner, resolution, *, min_support, gate, near=1.0, clearance=0.05):
    """The slope dz/dr of a ray that ends in a well supported cell and not below it, or passes the last half cell so.

    None for others. For a ray that leaves the window otherwise, the lowest ground counts that is well supported, of the
    strip along the border that the ray leaves through, as deep as `near`, and so far to both sides. A ray that is never
    more than `clearance` below that is believed, and taken for one that passes `clearance` above it.
    """
    shape, share, side = layers["validity"].shape, 1.0, None
    if cell_of(*hit[:2], corner, resolution, shape) is None:
        for k in range(2):
            low, high = corner[k] * resolution, (corner[k] + shape[k]) * resolution
            border = high - resolution / 2 if hit[k] > origin[k] else low + resolution / 2
            if hit[k] != origin[k] and (border - origin[k]) / (hit[k] - origin[k]) < share:
                share, side = (border - origin[k]) / (hit[k] - origin[k]), k
    share, length = max(share, 0.0), math.hypot(*(hit - origin)[:2])
    x, y, z = origin + share * (hit - origin)
    slope, c = (hit - origin)[2] / length, cell_of(x, y, corner, resolution, shape)
    if c is None:
        return None
    if well_supported(c, layers, resolution, min_support):
        margin = gate * math.sqrt(layers["variance"][c] + (resolution / 2) ** 2)
        if z >= layers["elevation"][c] - margin:
            return slope
    if side is None:
        return None
    n, border = max(1, int(near / resolution)), shape[side] - 1 if hit[side] > origin[side] else 0
    strip = [
        layers["elevation"][a]
        for a in np.ndindex(shape)
        if abs(a[side] - border) < n and abs(a[1 - side] - c[1 - side]) <= n
        if well_supported(a, layers, resolution, min_support)
    ]
    if not strip or min(origin[2], hit[2]) < min(strip) - clearance:
        return None
    return (max(z, min(strip) + clearance) - origin[2]) / (share * length)


def stays_above_recent(origin, hit, layers, corner, resolution, *, min_time, gate):
    """Whether a ray passes over all ground hit of late, sampled every two cells up to two cells before its hit."""
    horizontal, step = math.hypot(hit[0] - origin[0], hit[1] - origin[1]), 2 * resolution
    for k in range(math.floor(horizontal / step)):
        x, y, z = origin + (k + 0.5) * step / horizontal * (hit - origin)
        c = cell_of(x, y, corner, resolution, layers["validity"].shape)
        if c is None or not layers["validity"][c] or layers["time"][c] > min_time:
            continue
        if z < layers["elevation"][c] - gate * math.sqrt(layers["variance"][c] + (resolution / 2) ** 2):
            return False
    return True


def clear_seen_through(layers, lowest, direction, resolution, *, min_time, min_incidence, gate):
    """validity, bounded and upper bound after rays: remove if p_z < h - sigma, not hit of late, |r . n| > alpha_n.

    Whatever the normal, also if p_z < h - gate * sqrt(sigma^2 + (cell / 2)^2) - |gradient| * cell / 2.
    """
    validity, bounded, bound = (layers[n].copy() for n in ("validity", "bounded", "upper_bound"))
    for c in np.ndindex(validity.shape):
        if not math.isfinite(lowest[c]):
            continue
        gx, gy, half = layers["gradient_x"][c], layers["gradient_y"][c], resolution / 2
        normal = np.array([-gx, -gy, 1.0])
        incidence = abs(direction[c] @ normal) / np.linalg.norm(normal)
        depth = layers["elevation"][c] - lowest[c]
        far = depth > gate * math.hypot(math.sqrt(layers["variance"][c]), half) + math.hypot(gx, gy) * half
        below = depth > math.sqrt(layers["variance"][c])
        if validity[c] and below and layers["time"][c] > min_time and (far or incidence > min_incidence):
            validity[c] = bounded[c] = False
        if not validity[c]:
            bound[c] = min(bound[c], lowest[c]) if bounded[c] else lowest[c]
            bounded[c] = True
    return validity, bounded & ~validity, bound
