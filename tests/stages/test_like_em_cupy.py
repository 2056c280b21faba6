"""Maps that compute as elevation_mapping_cupy does."""

import math

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from tests import em_cupy_reference as reference
from torchelev import ElevationMap, ElevationMapConfig
from torchelev.stages.like_em_cupy import DEFAULTS

N, RESOLUTION = 16, 0.1
SMALL = dict(resolution=RESOLUTION, map_length=N * RESOLUTION, min_valid_distance=0.2, overlap_clear_range_xy=0.8)
BUSY = SMALL | dict(
    wall_num_thresh=4,
    min_height_drift_cnt=5,
    drift_compensation_alpha=0.5,
    max_ray_length=1.5,
    cleanup_step=0.2,
    overlap_clear_range_z=0.9,
    max_variance=0.3,
)
SENSOR = np.array([0.04, -0.03, 0.7])


def tilted():
    """Return axes of a sensor that looks down ahead."""
    a = math.radians(35)
    return np.array([[0.0, -math.sin(a), math.cos(a)], [-1.0, 0, 0], [0, -math.cos(a), -math.sin(a)]])


def scan(rng, number, at_most_one):
    """Return points (number, 3) in the map frame, on steps with outliers; of at most one a cell if asked."""
    if at_most_one:
        cells = rng.permutation((N - 2) ** 2)[:number]
        ij = np.stack([cells // (N - 2), cells % (N - 2)], -1) + 1
        xy = (ij + rng.uniform(0.1, 0.9, ij.shape) - N / 2) * RESOLUTION
    else:
        xy = rng.uniform(-1.0, 1.0, (number, 2))
    z = 0.2 * (xy[:, 0] > 0.3) + rng.normal(0, 0.01, len(xy))
    return np.column_stack([xy, z + rng.choice([0, 0.4, 1.2], len(xy), p=[0.8, 0.15, 0.05])])


def update(emap, points, dt=0.2, moving=None, sensor=SENSOR):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = torch.from_numpy(tilted()), torch.from_numpy(sensor)
    base = torch.eye(4, dtype=torch.float64)[None]
    emap.update(torch.from_numpy((points - sensor) @ tilted())[None], T[None], base, dt=dt, moving=moving)


@pytest.mark.parametrize("at_most_one", [True, False])
@pytest.mark.parametrize("changed", [{}, BUSY, BUSY | {"enable_edge_sharpen": False}])
def test_computes_what_the_code_computes(changed, at_most_one):
    rng = np.random.default_rng(3)
    given = SMALL | changed
    emap = ElevationMap(ElevationMapConfig.like_em_cupy(**given)).double()
    expected = reference.Map(N, RESOLUTION, (-N * RESOLUTION / 2,) * 2, DEFAULTS | given | {"traversability_inlier": 0})
    emap.cfg.drift.__dict__["min_traversability"] = 0.0  # the rating is of no interest here
    cleared = bounded = outliers = corrected = 0
    for k in range(8):
        if k == 4:  # what stood there is gone
            scans = scan(rng, 60, at_most_one) * [1, 1, 0] - [0, 0, 0.05]
        else:
            scans = scan(rng, 60 if at_most_one else 500, at_most_one)
        expected.normal = normals(emap)
        update(emap, scans, moving=k % 3 > 0)
        expected.update(scans, depths(scans), SENSOR, 0.2, moving=k % 3 > 0)
        state, statistics = emap.state, emap.statistics
        known = expected.valid > 0.5
        np.testing.assert_array_equal(state.validity[0].numpy(), known)
        np.testing.assert_array_equal((state.bounded & ~state.validity)[0].numpy(), expected.bounded & ~known)
        for layer, value in (
            ("elevation", expected.h),
            ("variance", expected.v),
            ("support", expected.valid),
            ("time", expected.time),
        ):
            np.testing.assert_allclose(
                getattr(state, layer)[0].numpy()[known], value[known], atol=1e-6, err_msg=f"{layer} {k}"
            )
        bound = expected.bounded & ~known
        np.testing.assert_allclose(state.upper_bound[0].numpy()[bound], expected.bound[bound], atol=1e-6)
        cleared += int(statistics.cleared_seen_through)
        bounded, outliers = bounded + bound.sum(), outliers + int(statistics.rejected_outlier)
        corrected += bool(statistics.drift_correction != 0)
    assert bounded > 20 and outliers > 20, "the scans show too little"
    if changed and not at_most_one:
        assert corrected > 1


def depths(points):
    return (points - SENSOR) @ tilted()[:, 2]


def normals(emap):
    gx, gy = (layer[0].numpy() for layer in (emap.state.gradient_x, emap.state.gradient_y))
    n = np.stack([-gx, -gy, np.ones_like(gx)], -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def test_the_order_of_the_points_does_not_matter():
    rng = np.random.default_rng(0)
    scans = [scan(rng, 400, False) for _ in range(4)]
    maps = [ElevationMap(ElevationMapConfig.like_em_cupy(**BUSY)) for _ in range(2)]
    for points in scans:
        update(maps[0], points)
        update(maps[1], rng.permutation(points))
    for name in ("elevation", "variance", "upper_bound", "validity"):
        a, b = (emap.layer(name).nan_to_num(-9) for emap in maps)
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4, msg=name)


def test_normals_are_the_differences_of_the_dilated_upper_bound():
    emap = ElevationMap(ElevationMapConfig.like_em_cupy(**SMALL, dilation_size=1, enable_visibility_cleanup=False))
    points = np.array([[0.05, 0.05, 0.3], [0.15, 0.05, 0.4], [-0.35, 0.35, 0.1]])
    update(emap, points)
    gx, gy = emap.state.gradient_x[0], emap.state.gradient_y[0]
    assert gx[8, 8] == pytest.approx(1.0, abs=0.05)
    assert gy[8, 8] == pytest.approx(0.0, abs=1e-6)  # (8, 9) is unknown, and takes the height of the cell before it
    assert gx[4, 11] == pytest.approx(0.0, abs=1e-6) and int(emap.state.has_normal.sum()) == 3


def test_says_that_tensors_compute_it_and_why():
    emap = ElevationMap(ElevationMapConfig.like_em_cupy(**SMALL))
    assert emap.backend.name == "TORCH" and "sensor.depth" in emap.backend.reason


def test_never_waits_for_the_device():
    with FakeTensorMode():
        emap = ElevationMap(ElevationMapConfig.like_em_cupy(**BUSY), num_envs=2)
        T = torch.zeros(2, 4, 4)
        emap.update(torch.zeros(2, 20, 3), T, T, dt=0.1, moving=torch.ones(2, dtype=torch.bool))
        assert emap.layer("elevation").shape == (2, N, N)


def test_runs_for_many_maps_as_for_one():
    rng = np.random.default_rng(1)
    cfg = ElevationMapConfig.like_em_cupy(**BUSY)
    points = torch.from_numpy(np.stack([scan(rng, 80, False) for _ in range(3)])).float()
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 2, 3] = 0.7
    many = ElevationMap(cfg, num_envs=3)
    many.update(points - T[:, None, :3, 3], T, T, dt=0.2)
    for b in range(3):
        one = ElevationMap(cfg)
        one.update(points[b, None] - T[b, None, None, :3, 3], T[b, None], T[b, None], dt=0.2)
        torch.testing.assert_close(one.layer("elevation")[0], many.layer("elevation")[b], equal_nan=True)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"resolutoin": 0.1}, "resolutoin: must be a parameter of the mode"),
        ({"map_length": "8"}, "map_length: must be a number"),
        ({"map_length": -1.0}, "map_length: must be positive"),
        ({"mahalanobis_thresh": 0.0}, "fusion.averaging.gate_per_variance: must be positive and finite"),
        ({"outlier_variance": -1.0}, "must not be negative"),
        ({"cleanup_step": -0.1}, "raycast.steps.validity_per_ray: must be finite and not negative"),
        ({"overlap_clear_range_xy": 0.0}, "overlap.square.side: must be positive and finite"),
        ({"dilation_size": -1}, "surface.upper_bound.dilation: must be a positive int"),
        ({"sensor_noise_factor": -0.1}, "sensor.depth.factor: must be finite and not negative"),
    ],
)
def test_refuses_wrong_parameters_by_name(given, words):
    with pytest.raises(ValueError, match=words.replace(".", r"\.")):
        ElevationMapConfig.like_em_cupy(**given)


def test_refuses_missing_weights_when_the_map_is_made(tmp_path):
    with pytest.raises(FileNotFoundError, match="must be a file of weights"):
        ElevationMap(ElevationMapConfig.like_em_cupy(weights=tmp_path / "none.npz"))


def test_config_survives_a_file(tmp_path):
    cfg = ElevationMapConfig.like_em_cupy(**BUSY)
    cfg.save(tmp_path / "cfg.json")
    assert ElevationMapConfig.load(tmp_path / "cfg.json") == cfg
