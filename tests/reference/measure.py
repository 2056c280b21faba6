"""From points to a measurement: gates, noise, depth images, voxels."""

import math

import numpy as np


def above_ramp(dx, dy, dz, slope, distance, offset, height):
    """The exclusion area: z - z_s > min(max(r - b, 0) * tan(theta_a) + c, d)."""
    r = math.hypot(dx, dy)
    return dz > min(max(r - distance, 0.0) * slope + offset, height)


def inside_box(point, T_map_base, lower, upper):
    """Whether a map-frame point lies in a box of the base frame."""
    in_base = np.linalg.inv(T_map_base) @ np.append(point, 1.0)
    return all(lower[k] <= in_base[k] <= upper[k] for k in range(3))


def measure(points, T_map_sensor, T_map_base, *, noise, limits, exclusion=None, body=None):
    """Transform and gate the points (S, N, 3) of sensors with poses (S, 4, 4): a list of dicts, sensor after sensor.

    Each has `gate`: "used", or the first gate that rejected it. sigma_p^2 = alpha_d * d^2 + floor, `noise` = (alpha_d,
    floor). `limits` = (minimum, maximum distance); `exclusion` and `body` are dicts of their parameters.
    """
    measured = []
    for s, cloud in enumerate(points):
        for p in cloud:
            out = {"sensor": s, "origin": T_map_sensor[s][:3, 3], "gate": "used"}
            measured.append(out)
            if not all(math.isfinite(c) for c in p):
                out["gate"] = "invalid"
                continue
            d = math.sqrt(sum(c * c for c in p)) if max(abs(c) for c in p) < 1e100 else math.inf
            if not limits[0] <= d <= limits[1]:
                out["gate"] = "range"
                continue
            turned = T_map_sensor[s][:3, :3] @ p
            out["point"] = turned + T_map_sensor[s][:3, 3]
            out["variance"] = noise[0] * d * d + noise[1]
            if body is not None and T_map_base is not None and inside_box(out["point"], T_map_base, **body):
                out["gate"] = "body"
            elif exclusion is not None and above_ramp(*turned, **exclusion):
                out["gate"] = "overhang"
    return measured


def depth_to_points(depth, fx, fy, cx, cy, along):
    """The points of a depth image (h, w), optical frame, row after row; NaN where there is no depth."""
    points = []
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            ray = np.array([(u - cx) / fx, (v - cy) / fy, 1.0])
            if along == "ray":
                ray = ray / np.linalg.norm(ray)
            d = depth[v, u]
            points.append(ray * d if math.isfinite(d) and d > 0 else np.full(3, math.nan))
    return np.array(points)


def voxel_means(points, size):
    """The mean of the points of each voxel, by voxel."""
    voxels = {}
    for p in points:
        if np.isfinite(p).all():
            voxels.setdefault(tuple(math.floor(c / size) for c in p), []).append(p)
    return {key: np.mean(group, axis=0) for key, group in voxels.items()}
