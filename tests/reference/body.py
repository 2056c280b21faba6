"""Which points lie on a robot's links, and where its links hide what is behind them."""

import math

import numpy as np


def rotation_of(quat_wxyz):
    """The matrix that turns v to v + 2 w (q x v) + 2 q x (q x v), column by column."""
    w, q = quat_wxyz[0], np.array(quat_wxyz[1:])
    return np.column_stack([v + 2 * w * np.cross(q, v) + 2 * np.cross(q, np.cross(q, v)) for v in np.eye(3)])


def outside_capsule(p, start, end, radius):
    """How far outside a capsule a point lies, both in the link's frame; negative inside."""
    start, axis = np.array(start), np.array(end) - np.array(start)
    v = min(max(np.dot(p - start, axis) / np.dot(axis, axis), 0.0), 1.0) if axis.any() else 0.0
    return np.linalg.norm(p - start - v * axis) - radius


def outside_box(p, center, half_lengths, rotation):
    """How far a point lies outside the faces of a box, both in the link's frame; negative inside."""
    in_box = (p - np.array(center)) @ rotation
    return max(abs(in_box[k]) - half_lengths[k] for k in range(3))


def least(f, low, high):
    """The least value of a convex function between two numbers, by thirds."""
    for _ in range(40):
        a, b = low + (high - low) / 3, high - (high - low) / 3
        low, high = (low, b) if f(a) <= f(b) else (a, high)
    return f((low + high) / 2)


def shapes_of(robot, T_map_links):
    """A function of a map-frame point for each shape: how far it lies outside, negative inside.

    `robot` holds lists of dicts, `T_map_links` the poses by the link's name.
    """
    shapes = []
    for kind, outside in (("capsules", outside_capsule), ("boxes", outside_box)):
        for shape in robot[kind]:
            to_link = np.linalg.inv(T_map_links[shape["link"]])
            sizes = {key: value for key, value in shape.items() if key not in ("link", "quat_wxyz")}
            if kind == "boxes":
                sizes["rotation"] = rotation_of(shape["quat_wxyz"])
            shapes.append(lambda p, f=outside, T=to_link, s=sizes: f(T[:3, :3] @ p + T[:3, 3], **s))
    return shapes


def outside_robot(p, origin, robot, T_map_links):
    """How far a point and what is up to `depth_tolerance` behind it lie outside the padded robot; on it if <= 0."""
    ray = (p - origin) / np.linalg.norm(p - origin)
    nearest = [
        least(lambda t, f=outside: f(p + t * ray), 0.0, robot["depth_tolerance"])
        for outside in shapes_of(robot, T_map_links)
    ]
    return min(nearest) - robot["padding"]


def first_hit(origin, ray, robot, T_map_links, reach):
    """The distance at which a ray enters its first shape from outside, inf for none.

    No shape is nearer than it is far outside, so that steps of that length enter none.
    """
    hits = [math.inf]
    for outside in shapes_of(robot, T_map_links):
        t, inside = 0.0, outside(origin) <= 0
        while not inside and t < reach:
            step = outside(origin + t * ray)
            if step < 1e-6:
                hits.append(t)
                break
            t += step
    return min(hits)
