"""Trees of transforms from functions of time."""

import numpy as np

from torchelev.io.bags.poses.rows import from_matrix
from torchelev.io.bags.poses.transforms import TransformTree

START = 1_700_000_000.0  # [s]
TIMES = np.arange(0.0, 10.0, 0.05)


def place(x=0.0, y=0.0, z=0.0, yaw=0.0, pitch=0.0):
    """The pose (4, 4) at a place, turned about z and then about y."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    T = np.eye(4)
    T[:3, :3] = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    T[:3, 3] = x, y, z
    return T


def drive(t):
    """A robot that drives ahead at 0.5 m/s."""
    return place(x=0.5 * t, yaw=0.1 * np.sin(t))


def sway(t):
    """A body that walks."""
    return place(z=0.3 + 0.02 * np.sin(12 * t), pitch=0.03 * np.sin(12 * t))


def nod(t):
    """A mast that moves up, down and sideways."""
    return place(z=0.5 + 0.4 * np.sin(t), yaw=np.sin(2 * t))


def spin(t):
    """A lidar that turns around."""
    return place(z=0.2, yaw=6 * t)


def fixed(t):
    """A mounting."""
    return place(x=0.1, z=0.3)


def stay(t):
    """A frame at its parent."""
    return place()


def jittered(t):
    """A mounting with the noise of rounding."""
    return place(x=0.1 + 1e-9 * np.sin(1e3 * t), z=0.3)


def correct(t):
    """A localisation that corrects odometry by jumps."""
    return place(x=0.2 * (t > 3), y=2.0 * (t > 6))


def tree_of(edges, static=(), times=TIMES):
    """A tree of (parent, child): pose at a time; of `static` pairs one pose, on the topic for these."""
    tree = TransformTree()
    for (parent, child), pose in edges.items():
        for t in times:
            tree.add(parent, child, START + t, from_matrix(pose(t)), recorded=START + t)
    for parent, child in static:
        tree.add(parent, child, START, from_matrix(fixed(0.0)), is_static=True, recorded=START)
    return tree
