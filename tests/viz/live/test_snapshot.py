"""What a picture of the live view holds."""

import numpy as np
import pytest
import torch

from tests.helpers import mapped, pose, small_map
from torchelev import HeightScan
from torchelev.viz.live import take_snapshot


def test_it_holds_the_layers_of_the_environment_asked_for():
    emap = mapped(num_envs=2)
    taken = take_snapshot(emap, env=1)
    assert np.array_equal(taken.map.layers["elevation"], emap.layer("elevation")[1].numpy(), equal_nan=True)
    assert not np.array_equal(taken.map.layers["elevation"], emap.layer("elevation")[0].numpy(), equal_nan=True)
    assert np.array_equal(taken.map.center, emap.center[1].numpy())


@pytest.mark.parametrize("num_sensors", [1, 2])
def test_clouds_come_to_the_map_frame(num_sensors):
    T = torch.stack([pose((s, 0, 1), yaw=0.5 * s) for s in range(num_sensors)], 1)  # (1, S, 4, 4)
    points = torch.randn(1, num_sensors, 7, 3, dtype=torch.float64)
    points[0, -1, 3] = torch.nan
    taken = take_snapshot(small_map(), T[:, 0], T, points)
    expected = [
        T[0, s, :3, :3].numpy() @ p + T[0, s, :3, 3].numpy() for s in range(num_sensors) for p in points[0, s].numpy()
    ]
    expected = np.array([p for p in expected if np.isfinite(p).all()])
    assert len(taken.cloud) == 7 * num_sensors - 1 and np.allclose(taken.cloud, expected)


def test_large_clouds_are_thinned():
    cloud = torch.rand(1, 100_000, 3)
    taken = take_snapshot(small_map(), pose(), pose(), cloud)
    assert 10_000 < len(taken.cloud) <= 20_000


def test_arrays_without_a_batch_dimension_do_too():
    T, scan = pose()[0].numpy(), np.random.default_rng(0).normal(size=(5, 3))
    taken = take_snapshot(small_map(), T, T, np.zeros((4, 3)), scan=scan, plan=scan)
    assert np.array_equal(taken.T_map_base, T) and taken.T_map_sensor.shape == (1, 4, 4)
    assert np.array_equal(taken.scan, scan) and np.array_equal(taken.plan, scan) and len(taken.cloud) == 4


def test_points_without_z_lie_on_the_map():
    emap, scan = mapped(num_envs=2), HeightScan.grid(length_x=0.8, length_y=0.6, resolution=0.1)
    T = pose(num_envs=2, yaw=0.3)
    taken = take_snapshot(emap, T, scan=scan.xy(T), env=1)
    z, known = emap.sample(scan.xy(T), mode="nearest")
    assert 0 < len(taken.scan) == int(known[1].sum())
    assert np.allclose(taken.scan[:, 2], z[1][known[1]].numpy())


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"T_map_base": np.eye(3)}, r"T_map_base: expected \(1, ..., 4, 4\).*\(3, 3\)"),
        ({"scan": np.zeros((2, 4))}, r"scan: expected"),
        ({"points": np.zeros((2, 3))}, r"T_map_sensor: expected the poses of the 1 clouds"),
        ({"points": np.zeros((2, 3)), "T_map_sensor": np.zeros((1, 2, 4, 4))}, r"T_map_sensor: expected the poses"),
        ({"T_map_base": np.zeros((2, 4, 4))}, r"T_map_base: expected \(1, ..., 4, 4\).*\(2, 4, 4\)"),
        ({"plan": np.zeros((4, 5, 3))}, r"plan: expected"),
        ({"plan": [[0.0, 1.0]]}, r"plan: expected"),
        ({"env": 1}, r"env: must lie in \[0, 1\)"),
    ],
)
def test_wrong_shapes_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        take_snapshot(small_map(), **wrong)
