"""Jumps are distinguished from motion, whatever the rate, speed and noise of the poses."""

import numpy as np
import pytest

from tests.io.bags.poses.trees import START, place, tree_of
from torchelev.io.bags.poses.doubts import describe_jumps
from torchelev.io.bags.poses.motion import find_jumps, motion


def path(rate, place_at, seconds=20.0, jitter=0.0, noise=0.0, drop=()):
    rng = np.random.default_rng(0)
    times = np.arange(0.0, seconds, 1 / rate)
    times = np.array([t for t in times if not any(a < t < b for a, b in drop)])
    poses = np.stack([place_at(t) for t in times])
    poses[:, :3, 3] += noise * rng.standard_normal((len(times), 3))
    stamps = np.sort(times + jitter * rng.uniform(-1, 1, len(times)))
    return START + stamps, poses


def stop_and_go(t):
    """A car that brakes and starts again within 3 s."""
    return place(x=15 * t if t < 5 else 75 + 25 * max(0.0, t - 10))


def circle(t):
    """A robot that turns fast and drives round."""
    return place(x=np.cos(2 * t), y=np.sin(2 * t), yaw=2 * t)


SOUND = {
    "walk": path(400, lambda t: place(x=t, z=0.02 * np.sin(12 * t))),
    "car with late stamps": path(50, lambda t: place(x=30 * t), jitter=0.01),
    "stop and go": path(10, lambda t: place(x=min(5 * t * t, 50 + 10 * t))),
    "seconds between poses": path(1, stop_and_go),
    "satellites": path(10, lambda t: place(x=2 * t), noise=0.15),
    "circle": path(20, circle),
    "gap on a straight": path(50, lambda t: place(x=10 * t), drop=[(5.0, 9.0)]),
    "gap in a turn": path(50, circle, drop=[(5.0, 7.0)]),
    "spinning lidar": path(40, lambda t: place(yaw=60 * t)),
    "still": path(50, lambda t: place(), noise=1e-3),
    "two poses": path(1, lambda t: place(x=t), seconds=2.0),
}


@pytest.mark.parametrize("name", SOUND)
def test_motion_is_no_jump(name):
    assert not find_jumps(*SOUND[name]).any()


JUMPS = {
    "restart": lambda t: place(x=0.5 * (t % 10)),
    "sideways": lambda t: place(x=t, y=3.0 * (t > 10)),
    "small": lambda t: place(x=t, y=0.5 * (t > 10)),
    "turn": lambda t: place(x=t, yaw=1.0 * (t > 10)),
    "car": lambda t: place(x=15 * t, y=5.0 * (t > 10)),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize("rate", [10, 50, 400])
@pytest.mark.parametrize("name", JUMPS)
def test_a_jump_is_found_once(name, rate):
    stamps, poses = path(rate, JUMPS[name])
    (index,) = np.flatnonzero(find_jumps(stamps, poses))
    assert stamps[index] - START == pytest.approx(10.0, abs=1.5 / rate)


def test_jumps_do_not_count_as_travel():
    tree = tree_of({("map", "odom"): lambda t: place(x=0.001 * t, y=5.0 * (t > 4))})
    assert motion(tree, "map", "odom").travel < 0.02
    assert motion(tree, "odom", "map").travel < 0.02
    assert motion(tree, "odom", "elsewhere") == (0.0, 0.0)


def test_a_turn_is_named_in_degrees_and_jumps_are_counted():
    tree = tree_of({("odom", "base"): lambda t: place(x=t, y=2.0 * (t > 3), yaw=1.0 * (t > 6))})
    (line,) = describe_jumps(tree, ["base", "base"], START)
    assert line.startswith("base jumps by 2.0 m in odom within 0.05 s") and ", and 1 times more:" in line
    tree = tree_of({("odom", "base"): lambda t: place(x=t, yaw=1.0 * (t > 6))})
    (line,) = describe_jumps(tree, ["base"], START)
    assert "and turns by 57 degrees in odom" in line
