"""A base whose quaternion is misread is named where it leaves a trace: on turns, and on rough ground."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.diagnosis.walks import DT, SENSORS, map_of, on_reordered_base, sound_scene
from torchelev.diagnosis.pose_hypotheses import explain
from torchelev.diagnosis.scan_fit import Scan
from torchelev.sim import mount, walk
from torchelev.sim.exact import scenes as library

ORDERS = {
    1: "the base's quaternion, in the order w x y z, was read as x y z w",
    -1: "the base's quaternion, in the order x y z w, was read as w x y z",
}
STRAIGHT = [(-2.6, 0.05), (0.6, 0.05)]
WALKS = {
    "a turn at the end": ("flat", 0.0, [(-1.0, 0.05), (0.6, 0.05), (0.6, -1.0)]),
    "a turn and back": ("boxes", 1.0, [(-1.0, 0.0), (0.5, 0.0), (-1.0, 0.0)]),
    "a turn on the spot": ("rough", 1.0, [(0.0, 0.0), (0.1, 0.0), (0.0, 0.0)]),
    "level": ("mixed", 0.0, STRAIGHT),
}


def simulate(sensor_name, scene_name, sway, route):
    """Scans (points, T_map_sensor, T_map_base) of a walk."""
    scene, (sensor, pitch) = getattr(library, scene_name)(), SENSORS[sensor_name]
    path = walk(scene, route, dt=DT, sway=sway, T_base_sensor=mount(pitch))
    poses = zip(path.T_map_sensor, path.T_map_base, strict=True)
    return [(sensor.cast(scene, T)[None], T[None], base[None]) for T, base in poses]


@pytest.mark.slow(12)
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("name", WALKS)
def test_a_misread_base_is_named(sensor, name):
    scans = simulate(sensor, *WALKS[name])
    assert map_of(scans).diagnose() == []
    for shift, words in ORDERS.items():
        first, *_ = map_of(scans, on_reordered_base(shift)).diagnose()
        assert first.startswith("poses: ") and words in first and ORDERS[-shift] not in first
        assert "(as given, the ground" in first or "(as given, scans agree in" in first


@pytest.mark.slow(9)
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("shift", ORDERS)
def test_a_misread_base_is_named_on_random_walks(seed, shift):
    scene, sensor, path, cfg, _ = sound_scene(seed)
    poses = list(zip(path.T_map_sensor, path.T_map_base, strict=True))[:12]
    scans = [(sensor.cast(scene, T)[None], T[None], base[None]) for T, base in poses]
    assert ORDERS[shift] in map_of(scans, on_reordered_base(shift), cfg=cfg).diagnose()[0]


@pytest.mark.slow(1)
def test_a_level_walk_along_x_over_flat_ground_shows_nothing():
    """A robot that walks backwards with its sensor behind would see the same."""
    scans = simulate("camera", "flat", 0.0, STRAIGHT)
    assert map_of(scans, on_reordered_base(-1)).diagnose() == []


ANGLES = st.tuples(st.floats(-3.1, 3.1), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))


def pose(rotation, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), position
    return T


@pytest.mark.slow(2)
@settings(max_examples=20, deadline=None)
@given(ANGLES, st.floats(0.8, 1.6), st.floats(-0.6, 0.6), st.sampled_from(list(ORDERS)))
def test_scans_of_a_misread_base_fit_without_the_mistake(start, turn, pitch, shift):
    """Of every attitude, turn and mounting: by SciPy's quaternions, on flat ground."""
    generator, scans = np.random.default_rng(0), []
    T_base_sensor = pose(Rotation.from_euler("Y", pitch), [0.3, 0.1, 0.2])
    for k in range(4):
        right = Rotation.from_euler("ZYX", np.add(start, [k * turn, 0, 0]))
        xyzw = right.as_quat()
        # Read in the other order: x y z w as w x y z, or back.
        wrong = Rotation.from_quat(np.roll(xyzw, -1) if shift == -1 else np.roll(xyzw, 1))
        position = [0.1 * k, 0.0, 0.6]
        T_map_sensor, T_map_base = pose(right, position) @ T_base_sensor, pose(wrong, position)
        ground = np.append(generator.uniform(-2, 2, (1500, 2)) + position[:2], np.zeros((1500, 1)), 1)
        points = (ground - T_map_sensor[:3, 3]) @ T_map_sensor[:3, :3]
        scans.append(Scan(points, T_map_base @ T_base_sensor, T_map_base))
    fit, mistakes = explain(scans)
    assert any(text.startswith(ORDERS[shift]) for text in mistakes), fit
    without = [Scan(scan.points, scan.T) for scan in scans]
    assert not any("base" in text for text in explain(without)[1])
