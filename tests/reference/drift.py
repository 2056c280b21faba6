"""Process noise, and drift compensation."""

import math

import numpy as np

from tests.reference.places import cell_of, center_of


def age(variance, time, dt, rate):
    """sigma_m^2 += sigma_t^2 * dt; the time since the last hit grows."""
    variance, time = variance.copy(), time.copy()
    for cell in np.ndindex(variance.shape):
        variance[cell] += rate * dt
        time[cell] += dt
    return variance, time


def drift(layers, points, corner, resolution, *, sigma2, gate, relief, max_drift, min_points, gain, **cells):
    """Number of points, mean error and correction: e = (1/n) sum (p_z - h) over points on certain, flat cells.

    On a slope, h is the height of the cell's plane at the point. Points farther than `gate` standard deviations from
    the mean error count no more, sigma^2 = `sigma2` of the points + relief^2.
    """
    errors = [e for p in points if (e := height_error(layers, p, corner, resolution, **cells)) is not None]
    mean = sum(errors) / max(1, len(errors))
    errors = [e for e in errors if abs(e - mean) <= gate * math.sqrt(sigma2 + relief**2)]
    mean = sum(errors) / max(1, len(errors))
    return len(errors), mean, gain * mean if len(errors) >= min_points and abs(mean) <= max_drift else 0.0


def height_error(layers, point, corner, resolution, *, min_traversability, max_variance, max_error):
    """The height of a point over the map, or None where it cannot measure drift."""
    cell = cell_of(point[0], point[1], corner, resolution, layers["elevation"].shape)
    if cell is None or not layers["validity"][cell]:
        return None
    if layers["traversability"][cell] < min_traversability or layers["variance"][cell] > max_variance:
        return None
    x, y = center_of(*cell, corner, resolution)
    slope = layers["gradient_x"][cell] * (point[0] - x) + layers["gradient_y"][cell] * (point[1] - y)
    error = point[2] - layers["elevation"][cell] - slope
    return error if abs(error) <= max_error else None
