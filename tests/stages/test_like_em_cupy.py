"""Maps that compute as elevation_mapping_cupy does."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from tests import em_cupy_reference as reference
from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, FusionConfig
from torchelev.stages.like_em_cupy import DEFAULTS
from torchelev.traversability.paper_filter import SHAPES

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
    cfg = ElevationMapConfig.like_em_cupy(**given)  # of which the rating is of no interest here
    emap = ElevationMap(replace(cfg, drift=cfg.drift and replace(cfg.drift, min_traversability=0.0))).double()
    expected = reference.Map(N, RESOLUTION, (-N * RESOLUTION / 2,) * 2, DEFAULTS | given | {"traversability_inlier": 0})
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


def test_cells_that_no_scan_founded_stay_until_rays_contradict_them():
    emap = ElevationMap(ElevationMapConfig.like_em_cupy(**SMALL))
    feet = torch.tensor([[[0.4, 0.4, 0.1], [0.4, -0.4, 0.1], [-0.4, 0.4, 0.1], [-0.4, -0.4, 0.1]]])
    emap.initialize(feet)
    known = int(emap.state.validity.sum())
    update(emap, np.full((3, 3), np.nan))
    assert known > 40 and int(emap.state.validity.sum()) == known
    update(emap, np.array([[0.75, 0.0, -1.0], [0.76, 0.01, -1.0]]), dt=1.0)
    assert 0 < known - int(emap.state.validity.sum()) < 20


@pytest.mark.parametrize("drift", [True, False])
def test_the_error_of_the_pose_counts_as_without_the_mode(drift):
    """As by default, what the pose adds is no part of a new map's variance, but of the state."""
    covariance = torch.diag(torch.tensor([0.0, 0.0, 0.04, 0.0, 0.0, 0.0]))[None]
    variances = []
    for given in (None, covariance):
        emap = ElevationMap(ElevationMapConfig.like_em_cupy(**SMALL, enable_drift_compensation=drift))
        T = torch.eye(4)[None]
        T[:, 2, 3] = 0.7
        emap.update(torch.tensor([[[0.05, 0.05, -0.7]]]), T, T, dt=0.1, pose_covariance=given)
        variances.append(float(emap.state.variance[emap.state.validity]))
    assert variances[0] == pytest.approx(variances[1], rel=1e-5)
    assert float(emap.state.pose_covariance[0, 2, 2]) == pytest.approx(0.04)


def test_several_sensors_are_fused_as_one():
    rng = np.random.default_rng(2)
    points = torch.from_numpy(scan(rng, 60, False) - SENSOR).float()
    T = torch.eye(4)[None]
    T[0, :3, 3] = torch.from_numpy(SENSOR)
    one, two = (ElevationMap(ElevationMapConfig.like_em_cupy(**BUSY)) for _ in range(2))
    one.update(points[None], T, T, dt=0.1)
    two.update(points.view(1, 2, 30, 3), T[:, None].repeat(1, 2, 1, 1), T, dt=0.1)
    torch.testing.assert_close(one.layer("elevation"), two.layer("elevation"), equal_nan=True)
    torch.testing.assert_close(one.layer("upper_bound"), two.layer("upper_bound"), equal_nan=True)


def test_rates_the_dilated_upper_bound_by_the_filter(tmp_path):
    weights = {name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()}
    weights["conv1.weight"][0, 0, 1, 1:] = -1, 1  # the difference to the next cell along y
    weights["conv_final.weight"][0, 0] = 5
    np.savez(tmp_path / "weights.npz", **weights)
    cfg = ElevationMapConfig.like_em_cupy(weights=tmp_path / "weights.npz", **SMALL)
    emap = ElevationMap(replace(cfg, raycast=None))
    update(
        emap, np.array([[x, y, 0.1 * (y > 0)] for x in np.arange(-0.75, 0.8, 0.1) for y in np.arange(-0.75, 0.8, 0.1)])
    )
    rating = emap.layer("traversability")[0]
    torch.testing.assert_close(
        rating[8, 4:11], torch.exp(-5 * torch.tensor([0, 0, 0, 0.1, 0, 0, 0])), atol=0.02, rtol=0
    )
    assert rating[:2].isnan().all() and rating[2:-2, 2:-2].isfinite().all()


def test_channels_come_with_the_noise_of_the_depth_and_not_from_above_the_ramp():
    cfg = ElevationMapConfig.like_em_cupy(**SMALL, ramped_height_range_c=-0.3)
    emap = ElevationMap(replace(cfg, channels={"rgb": ChannelConfig(kind="color", tolerance=1e6)}))
    T = torch.eye(4)[None]
    T[:, 2, 3] = 0.7
    points = torch.tensor([[[0.05, 0.05, -0.7], [0.05, 0.05, -0.1]]])  # ground, and a ceiling above it
    emap.update(points, T, T, dt=0.1, features={"rgb": torch.tensor([[[1.0, 0, 0], [0, 0, 1.0]]])})
    assert emap.layer("rgb")[0, :, 8, 8].tolist() == [1, 0, 0]
    assert float(emap.channels.channel("rgb").weight[0, 8, 8]) == pytest.approx(1e-4 / (0.05 * 0.49), rel=1e-3)


def test_rays_by_steps_need_the_averaged_fusion():
    cfg = ElevationMapConfig.like_em_cupy(**SMALL)
    with pytest.raises(ValueError, match=r"cfg.raycast.steps: needs fusion.averaging.*give both, or neither"):
        replace(cfg, fusion=FusionConfig())


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
