"""A small recording: a sensor drives past a box."""

import numpy as np

NUM_SCANS = 4
HEIGHT = 1.2  # [m] of the sensor above the ground


def sensor_poses():
    """A sensor that moves along x and turns to the left, (T, 4, 4)."""
    poses = np.tile(np.eye(4), (NUM_SCANS, 1, 1))
    for k, angle in enumerate(np.linspace(0, 0.5, NUM_SCANS)):
        c, s = np.cos(angle), np.sin(angle)
        poses[k, :3] = [[c, -s, 0, 0.25 * k], [s, c, 0, 0], [0, 0, 1, HEIGHT]]
    return poses


def world_points(seed):
    """Ground at z = 0 within 4 m, and the top of a box 0.4 m high at x 2 to 3, y 1 to 2, in the map frame."""
    xy = np.random.default_rng(seed).uniform(-4, 4, (20000, 2))
    on_box = (np.abs(xy - [2.5, 1.5]) < 0.5).all(axis=1)
    return np.column_stack([xy, 0.4 * on_box])


def write_poses(path, poses):
    np.savetxt(path, poses[:, :3].reshape(-1, 12))


def value_at(saved, x, y, layer="elevation"):
    i, j = np.floor((np.array([x, y]) - saved.center[:2]) / saved.resolution + np.array(saved.layers[layer].shape) / 2)
    return saved.layers[layer][int(i), int(j)]


def cut_scan(folder):
    (folder / "scans" / "000002.bin").write_bytes(b"cut")
    return "000002.bin: cut short"


def raise_interrupt():
    raise KeyboardInterrupt
