"""elevation_mapping_cupy's update as its code computes it, point after point, in plain Python.

Written from its behaviour, in float64. A point's order matters there; here the farthest from its cell comes first, and
all rays after all points, and those that bound cells after those that clear them.
"""

import math

import numpy as np


class Map:
    """Layers (n, n) of one map whose corner is at `corner` [m]; heights in the map frame."""

    def __init__(self, n, resolution, corner, p):
        self.n, self.resolution, self.corner, self.p = n, resolution, corner, p
        self.h, self.time, self.bound = (np.zeros((n, n)) for _ in range(3))
        self.v = np.full((n, n), p["initial_variance"])
        self.valid, self.bounded = np.zeros((n, n)), np.zeros((n, n), bool)
        self.normal = np.zeros((n, n, 3))

    def cell(self, x, y):
        i, j = (math.floor((c - o) / self.resolution) for c, o in zip((x, y), self.corner, strict=True))
        return (i, j) if 0 <= i < self.n and 0 <= j < self.n else None

    def is_usable(self, point, origin):
        p = self.p
        center = np.add(self.corner, self.n * self.resolution / 2)
        ramp = max(math.hypot(*(point[:2] - center)) - p["ramped_height_range_b"], 0) * p["ramped_height_range_a"]
        above = point[2] - origin[2]
        near = math.dist(point, origin) < p["min_valid_distance"]
        return not near and above <= ramp + p["ramped_height_range_c"] and above <= p["max_height_range"]

    def update(self, points, depths, origin, dt, moving=True):
        """Fuse points (N, 3) in the map frame, at depths (N,) along the sensor's z axis [m]."""
        p = self.p
        self.time[self.valid > 0.5] += dt
        self.v[self.valid > 0.5] += p["time_variance"] * p["update_variance_fps"] * dt
        usable = [k for k in range(len(points)) if self.is_usable(points[k], origin)]
        inside = [(k, self.cell(*points[k][:2])) for k in usable if self.cell(*points[k][:2])]
        if p["enable_drift_compensation"]:
            self.drift(points, inside, moving)
        counts = {c: sum(c == other for _, other in inside) for _, c in inside}
        new = self.insert(points, depths, inside, counts)
        self.v0, self.valid0 = self.v.copy(), self.valid.copy()  # rays read what was before them
        if p["enable_visibility_cleanup"]:
            for contradict in (True, False):
                for k in usable:
                    self.cast(points[k], origin, contradict)
        for c, found in new.items():
            self.h[c], self.v[c] = np.mean([h for h, _ in found]), np.mean([v for _, v in found])
        lost = (self.valid < 0.5) | (self.v > p["max_variance"]) & (self.valid > 0.5)
        self.valid[lost] = 0
        self.v[lost] = p["initial_variance"]
        if p["enable_overlap_clearance"]:
            self.clear_square(origin)

    def drift(self, points, inside, moving):
        p, errors = self.p, []
        for k, c in inside:
            error = points[k][2] - self.h[c]
            certain = self.valid[c] > 0.5 and self.v[c] < p["drift_compensation_variance_inlier"] / 2
            if certain and abs(error) < p["mahalanobis_thresh"] * self.v[c]:
                errors.append(error)
        if moving and len(errors) > p["min_height_drift_cnt"] and abs(np.mean(errors)) < p["max_drift"]:
            self.h += p["drift_compensation_alpha"] * np.mean(errors)

    def insert(self, points, depths, inside, counts):
        """Insert points one by one, the farthest from its cell first; return the heights and variances per cell."""
        p, new = self.p, {}
        for k, c in sorted(inside, key=lambda item: -abs(points[item[0]][2] - self.h[item[1]])):
            z, h, v = points[k][2], self.h[c], self.v[c]
            if abs(h - z) > p["mahalanobis_thresh"] * v:
                self.v[c] += p["outlier_variance"]
                continue
            many = p["enable_edge_sharpen"] and counts[c] > p["wall_num_thresh"]
            if many and z < h - p["mahalanobis_thresh"] * v / counts[c]:
                continue
            noise = p["sensor_noise_factor"] * depths[k] ** 2 + 1e-9
            new.setdefault(c, []).append(((h * noise + z * v) / (v + noise), v * noise / (v + noise)))
        for c in new:
            self.valid[c], self.time[c], self.bounded[c] = 1, 0, False
        return new

    def cast(self, point, origin, contradict):
        """Follow a ray: rays first contradict cells, then bound those that are not known."""
        p, last = self.p, None
        distance = math.dist(point, origin)
        direction, length = (point - origin) / distance, min(distance, p["max_ray_length"])
        step = self.resolution / math.sqrt(2)
        s = step
        while s < length:
            at = origin + s * direction
            c = self.cell(*at[:2])
            s += step
            if c is None or c == last:
                continue
            last = c
            if math.dist(point, at) ** 2 < 0.1:
                continue
            if not contradict:
                if self.valid[c] < 0.5:
                    self.lower(c, at[2])
            elif self.valid0[c] > 0.5 and self.time[c] >= 0.5 and self.h[c] > at[2] + 0.01 - 0.05 * min(self.v0[c], 1):
                if abs(direction @ self.normal[c]) >= p["cleanup_cos_thresh"]:
                    self.valid[c] -= p["cleanup_step"] / (length / p["max_ray_length"])
                    self.v[c] += p["outlier_variance"]

    def lower(self, c, height):
        if not self.bounded[c] or height < self.bound[c]:
            self.bound[c], self.bounded[c] = height, True

    def clear_square(self, origin):
        half = int(self.p["overlap_clear_range_xy"] / self.resolution) // 2
        middle = slice(max(self.n // 2 - half, 0), self.n // 2 + half)
        for known, height in ((self.valid, self.h), (self.bounded, self.bound)):
            far = np.abs(height[middle, middle] - origin[2]) > self.p["overlap_clear_range_z"]
            known[middle, middle][far] = 0
