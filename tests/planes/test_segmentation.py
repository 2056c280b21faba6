"""Planes of ground whose planes are known, and of ground that is anything."""

import math
from dataclasses import astuple

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.planes import PlaneConfig, segment
from torchelev.sim.exact.plane_scenes import RISE, RUN, SCENES, TREADS, grid, hills, mixed, noisy, ramp, stairs

pytest.importorskip("cv2")
SEEDS = st.integers(0, 10_000)


def polygon_area(polygon):
    """Signed, in x and y."""
    (x, y), (u, v) = polygon[:, :2].T, np.roll(polygon[:, :2], -1, 0).T
    return ((x * v - u * y).sum()) / 2


def angle(region, normal):
    """Degrees between a region's normal and another vector."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    return math.degrees(math.asin(min(1.0, np.linalg.norm(np.cross(region.normal, normal)))))


def border_distance(region, rectangle):
    """The largest distance of a region's corners from the border of (x0, y0, x1, y1), inside or outside."""
    x0, y0, x1, y1 = rectangle
    x, y = region.boundary[:, 0], region.boundary[:, 1]
    outside = np.hypot(np.maximum(0, np.maximum(x0 - x, x - x1)), np.maximum(0, np.maximum(y0 - y, y - y1)))
    inside = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y)).clip(min=0)
    return max(outside.max(), inside.max())


def at(planes, x, y, resolution, shape):
    """The region of the cell that holds a point."""
    i, j = (int(math.floor(v / resolution + n / 2)) for v, n in zip((x, y), shape, strict=True))
    return planes.regions[planes.labels[i, j]]


def require_consistent(planes, resolution):
    """What holds of any segmentation."""
    labels, regions = planes.labels, planes.regions
    assert labels.dtype == np.int32 and labels.min() >= -1 and labels.max() == len(regions) - 1
    for k, region in enumerate(regions):
        cells = (labels == k).sum()
        assert region.label == k and cells > 0
        assert math.isclose(region.area, cells * resolution**2)
        rings = [region.boundary, *region.holes]
        assert math.isclose(sum(map(polygon_area, rings)), region.area, rel_tol=1e-6)
        assert polygon_area(region.boundary) > 0 and all(polygon_area(hole) < 0 for hole in region.holes)
        assert all(polygon_area(p) > 0 for p in region.inset) and all(polygon_area(p) < 0 for p in region.inset_holes)
        assert math.isclose(np.linalg.norm(region.normal), 1) and region.normal[2] > 0
        scale = max(1.0, np.abs(region.point).max())
        for polygon in [*rings, *region.inset, *region.inset_holes]:
            assert polygon.dtype == np.float64 and polygon.shape[1:] == (3,) and len(polygon) >= 3
            assert np.abs((polygon - region.point) @ region.normal).max() < 1e-9 * scale
        assert sum(map(polygon_area, region.inset + region.inset_holes)) <= region.area


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", [0.02, 0.04])
@pytest.mark.parametrize("seed", [0, 1])
def test_every_tread_of_stairs_is_a_plane(resolution, seed):
    """Height within 5 mm, normal within 1 degree, boundary within one cell."""
    height = stairs(resolution)
    (planes,) = segment(noisy(height, seed), resolution)
    require_consistent(planes, resolution)
    assert len(planes.regions) == TREADS + 1
    for k in range(1, TREADS):
        low = -2 + (k - 1) * RUN
        region = at(planes, low + RUN / 2, 0.0, resolution, height.shape)
        assert angle(region, (0, 0, 1)) < 1
        corners = region.onto(np.array([[low, -1.5], [low + RUN, 1.5]]))
        assert np.abs(corners[:, 2] - k * RISE).max() < 0.005 and abs(region.point[2] - k * RISE) < 0.005
        assert border_distance(region, (low, -1.5, low + RUN, 1.5)) < resolution
        assert not region.holes and len(region.inset) == 1


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08, 0.1])
def test_ramp_and_landing_are_apart(resolution):
    """They touch along a crease of 16.7 degrees, where they differ by as much as the noise in the cells beside it."""
    height = mixed(resolution)
    (planes,) = segment(noisy(height), resolution)
    require_consistent(planes, resolution)
    sloped, landing = (at(planes, x, 2.5, resolution, height.shape) for x in (-2.5, 0.5))
    assert angle(sloped, (-0.3, 0, 1)) < 0.5 and angle(landing, (0, 0, 1)) < 0.5
    np.testing.assert_allclose(sloped.onto(np.array([-2.5, 2.5]))[2], 0.45, atol=0.005)
    assert abs(landing.point[2] - 0.9) < 0.005
    assert border_distance(landing, (-1, 1, 2, 4)) <= resolution + 1e-9
    assert abs(sloped.area - 9) < 0.3 and abs(landing.area - 9) < 0.3


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08])
def test_a_ring_has_its_hole(resolution):
    height = mixed(resolution)
    (planes,) = segment(noisy(height), resolution)
    ring = at(planes, 3.1, -2.5, resolution, height.shape)
    assert abs(ring.point[2] - 0.25) < 0.005 and len(ring.holes) == 1
    for polygon, radius in ((ring.boundary, 1.6), (ring.holes[0], 0.6)):
        away = np.hypot(*(polygon[:, :2] - [2, -2.5]).T)
        assert np.abs(away - radius).max() < resolution
    assert len(ring.inset) == len(ring.inset_holes) == 1
    floor_inside = at(planes, 2, -2.5, resolution, height.shape)
    assert abs(floor_inside.point[2]) < 0.005 and floor_inside.area < 1.3


def test_coplanar_patches_apart_are_two_regions():
    x, y = grid(0.04, 4.0)
    (planes,) = segment(noisy(np.where(np.abs(x) < 0.1, np.nan, 0.2 * x)), 0.04)
    require_consistent(planes, 0.04)
    assert len(planes.regions) == 2
    for region in planes.regions:
        np.testing.assert_allclose(region.normal, np.array([-0.2, 0, 1]) / math.hypot(0.2, 1), atol=1e-3)
    assert sorted(round(float(r.bounding_box[k][0]), 6) for r in planes.regions for k in (0, 1)) == [-2, -0.08, 0.08, 2]


def test_rough_ground_has_no_planes_and_a_wall_neither():
    x, _ = grid(0.04, 4.0)
    rough = torch.from_numpy(np.random.default_rng(0).uniform(-0.1, 0.1, x.shape))
    wall = torch.from_numpy(2.0 * x)
    assert [len(planes.regions) for planes in segment(torch.stack([rough, wall]), 0.04)] == [0, 0]


@pytest.mark.parametrize("resolution", [0.04, 0.1])
def test_hills_are_cut_until_planar(resolution):
    """Cells lie near the planes of their regions, nearly all have one, and regions are not crumbs."""
    height = hills(resolution)
    (planes,) = segment(noisy(height), resolution)
    require_consistent(planes, resolution)
    x, y = grid(resolution)
    labels = planes.labels
    for k, region in enumerate(planes.regions):
        z = region.onto(np.column_stack([x[labels == k], y[labels == k]]))[:, 2]
        assert np.sqrt(np.mean((z - height[labels == k]) ** 2)) < 0.011 and region.roughness < 0.0105
    assert (labels >= 0).mean() > 0.98
    assert np.median([region.area for region in planes.regions]) > 0.15


def test_no_neighbours_on_hills_could_be_one_region():
    """Together, the cells of one of them at least are rougher than a region may be, but for a tenth of a millimetre."""
    elevation = noisy(hills(0.1))
    (planes,) = segment(elevation, 0.1)
    points = np.dstack([*grid(0.1), elevation[0].double().numpy()])
    labels, pairs = planes.labels, set()
    for a, b in ((labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1])):
        beside = (a != b) & (a >= 0) & (b >= 0)
        pairs |= {tuple(sorted(pair)) for pair in zip(a[beside].tolist(), b[beside].tolist(), strict=True)}
    worst = []
    for pair in pairs:
        mine = [points[labels == k] for k in pair]
        both = np.concatenate(mine)
        normal = np.linalg.svd(both - both.mean(0), full_matrices=False)[2][2]
        worst.append(max(np.sqrt(np.mean(((cells - both.mean(0)) @ normal) ** 2)) for cells in mine))
    assert np.sum(np.array(worst) < 0.0099) <= 0.01 * len(worst)


@pytest.mark.parametrize("scene", SCENES)
def test_cells_lie_near_their_planes(scene):
    elevation = noisy(SCENES[scene](0.04))
    (planes,) = segment(elevation, 0.04)
    x, y = grid(0.04)
    for k, region in enumerate(planes.regions):
        mine = planes.labels == k
        points = np.column_stack([x[mine], y[mine], elevation[0].numpy()[mine]])
        distance = np.abs((points - region.point) @ region.normal)
        assert distance.max() < 0.025 + 0.004  # they joined before the last fit
        assert math.isclose(region.roughness, np.sqrt(np.mean(distance**2)), rel_tol=1e-3)


@pytest.mark.parametrize("resolution", [0.04, 0.1])
def test_a_platform_with_a_narrow_ramp_is_three_planes(resolution):
    """Two large parallel planes that a few sloped cells join: cut by height first, then put together again."""
    x, y = grid(resolution)
    height = np.where((np.abs(y) < 0.6) & (x < 2), ramp(x, 0.0, 2.0, 0.5), np.where(x > 2, 0.5, 0.0))
    (planes,) = segment(noisy(height), resolution)
    require_consistent(planes, resolution)
    inclination = sorted(round(angle(region, (0, 0, 1))) for region in planes.regions)
    assert inclination == [0, 0, 14]
    assert sorted(round(region.area) for region in planes.regions) == [2, 30, 68]


def test_slopes_are_the_same_at_any_resolution():
    """Areas and heights of the same ground at 2, 4, 8 cm agree to a cell along the border and 5 mm."""
    found = []
    for resolution in (0.02, 0.04, 0.08):
        height = mixed(resolution)
        (planes,) = segment(noisy(height), resolution)
        regions = [at(planes, x, y, resolution, height.shape) for x, y in ((-2.5, 2.5), (0.5, 2.5), (3.1, -2.5))]
        found.append([(r.area, r.onto(np.array([0.0, 0.0]))[2]) for r in regions])
    np.testing.assert_allclose(np.array(found)[:, :, 0].std(0), 0, atol=0.15)
    np.testing.assert_allclose(np.array(found)[:, :, 1].std(0), 0, atol=0.005)


def test_places_follow_center_and_the_axes():
    """i grows with x, j with y; a center moves x and y, not z."""
    z = np.full((30, 20), np.nan)
    z[20:28, 2:10] = 1.5  # x in [0.2, 0.52], y in [-0.32, 0.0] at 4 cm around the origin
    (planes,) = segment(torch.from_numpy(z), 0.04, center=(10.0, -20.0, 7.0))
    (region,) = planes.regions
    np.testing.assert_allclose(region.bounding_box, [[10.2, -20.32], [10.52, -20.0]])
    np.testing.assert_allclose(region.point, [10.36, -20.16, 1.5])
    np.testing.assert_allclose(region.boundary[:, 2], 1.5)
    np.testing.assert_allclose(region.area, 0.32**2)
    np.testing.assert_array_equal(planes.labels, np.where(np.isnan(z), -1, 0))
    (inset,) = region.inset
    np.testing.assert_allclose([inset.min(0)[:2], inset.max(0)[:2]], [[10.24, -20.28], [10.48, -20.04]])


def test_batch_is_single_and_repeats_itself():
    elevation = torch.cat([noisy(stairs(0.1)), noisy(mixed(0.1)), noisy(hills(0.1))]).double()
    centers = torch.tensor([[0.0, 0.0], [5.0, 1.0], [-3.0, 2.0]])
    together = segment(elevation, 0.1, center=centers)
    for planes, one, center in zip(together, elevation, centers, strict=True):
        (single,) = segment(one, 0.1, center=center)
        np.testing.assert_array_equal(planes.labels, single.labels)
        for a, b in zip(planes.regions, single.regions, strict=True):
            np.testing.assert_allclose(a.boundary, b.boundary, atol=1e-9)
            np.testing.assert_allclose(a.normal, b.normal, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_high_places_are_as_good(dtype):
    """3 km up: float32 rounds heights to 0.2 mm, nothing else changes."""
    low, high = (segment(noisy(stairs(0.1)).to(dtype) + z, 0.1)[0] for z in (0.0, 3000.0))
    assert len(low.regions) == len(high.regions) == TREADS + 1
    for a, b in zip(low.regions, high.regions, strict=True):
        np.testing.assert_allclose(b.point[2] - a.point[2], 3000, atol=3e-4)
        np.testing.assert_allclose(a.normal, b.normal, atol=3e-3)


@pytest.mark.slow(1)
def test_unknown_is_nan_or_inf_and_leaves_the_rest_alone():
    height = stairs(0.04)
    elevation = noisy(height)
    gone = torch.from_numpy(np.random.default_rng(2).uniform(size=height.shape) < 0.15)
    (planes,) = segment(torch.where(gone, torch.nan, elevation), 0.04)
    (same,) = segment(torch.where(gone, torch.inf, elevation), 0.04)
    np.testing.assert_array_equal(planes.labels, same.labels)
    require_consistent(planes, 0.04)
    assert (planes.labels[gone[..., :].numpy()] == -1).all()
    for k in range(1, TREADS):
        x = -2 + (k - 0.5) * RUN
        heights = [region.point[2] for region in planes.regions if abs(region.onto(np.array([x, 0.0]))[2]) > 0]
        assert min(abs(z - k * RISE) for z in heights) < 0.005


def test_absurd_heights_are_unknown_and_leave_the_rest_alone():
    z = torch.zeros(20, 20)
    z[10, 10], z[3, 4] = 1e30, -2e5
    (planes,) = segment(z, 0.1)
    (region,) = planes.regions
    assert (planes.labels == -1).sum() == 2 and planes.labels[10, 10] == planes.labels[3, 4] == -1
    np.testing.assert_allclose(region.point[2], 0, atol=1e-9)


def test_regions_as_a_whole_are_not_too_steep_either():
    """By noise, windows on a slope just over the limit are just under it in places."""
    x, _ = grid(0.04, 4.0)
    elevation = noisy(math.tan(0.61) * x).double()
    assert len(segment(elevation, 0.04, PlaneConfig(max_inclination=0.63))[0].regions) == 1
    (planes,) = segment(elevation, 0.04, PlaneConfig(max_inclination=0.6))
    assert all(math.acos(region.normal[2]) <= 0.6 + 1e-9 for region in planes.regions)
    assert (planes.labels >= 0).mean() < 0.5


def test_small_regions_are_left_out():
    z = torch.full((40, 40), torch.nan)
    z[2:10, 2:10], z[20:38, 20:38] = 0.0, 0.0
    assert [len(segment(z, 0.04, PlaneConfig(min_area=a))[0].regions) for a in (0.0, 0.2, 1.0)] == [2, 1, 0]


def test_margin_shrinks_the_inset():
    z = torch.zeros(30, 30)
    areas = []
    for margin in (0.0, 0.1, 0.5, 0.7):
        (region,) = segment(z, 0.04, PlaneConfig(margin=margin))[0].regions
        areas.append(sum(map(polygon_area, region.inset)))
    np.testing.assert_allclose(areas, [1.16**2, 1.0**2, 0.2**2, 0], atol=1e-9)


def test_frames_lie_on_their_planes():
    x, y = grid(0.04, 2.0)
    (region,) = segment(torch.from_numpy(0.3 * x - 0.2 * y + 1), 0.04)[0].regions
    T = region.T_map_plane
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) > 0 and T[1, 0] == 0 and T[0, 0] > 0
    on_plane = (T @ np.array([0.3, -0.2, 0, 1]))[:3]
    np.testing.assert_allclose(on_plane[2], 0.3 * on_plane[0] - 0.2 * on_plane[1] + 1, atol=1e-9)


@given(
    SEEDS,
    st.tuples(st.integers(1, 40), st.integers(1, 40)),
    st.sampled_from([0.02, 0.04, 0.1]),
    st.sampled_from([torch.float16, torch.float32, torch.float64]),
    st.sampled_from([0.0, 0.02, 1.0, 1e4, 1e30, 1e300]),
    st.floats(0, 1),
)
def test_any_map_is_segmented(seed, shape, resolution, dtype, height, known):
    """Planes, steps, slopes, noise, speckles, infinities and heights beyond measure."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    z = rng.uniform(-0.5, 0.5, 2) @ np.stack([x.ravel(), y.ravel()]) * resolution
    z += 0.1 * (rng.uniform(-1, 1) * x.ravel() + rng.uniform(-1, 1) * y.ravel() > rng.uniform(-20, 20))
    z += rng.choice([0, 0.002, 0.02]) * rng.normal(size=z.size)
    z[rng.uniform(size=z.size) < 0.1] += height
    z[rng.uniform(size=z.size) > known] = rng.choice([np.nan, np.inf, -np.inf])
    elevation = torch.from_numpy(z.reshape(shape)).to(dtype)
    (planes,) = segment(elevation, resolution, PlaneConfig(min_area=rng.choice([0.0, 0.04])))
    assert planes.labels.shape == shape
    require_consistent(planes, resolution)
    assert (planes.labels[~np.isfinite(elevation.double().numpy())] == -1).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 2), (3, 3), (1000, 7), (7, 1000)])
@pytest.mark.parametrize("value", [0.0, 5.0, math.nan, math.inf])
def test_odd_shapes_are_segmented(shape, value):
    (planes,) = segment(torch.full(shape, value), 0.1)
    require_consistent(planes, 0.1)
    flat = math.isfinite(value) and min(shape) >= 2
    assert len(planes.regions) == flat and ((planes.labels == 0) == flat).all()


@pytest.mark.slow(2)
def test_a_large_map_is_segmented():
    (planes,) = segment(noisy(np.tile(hills(0.04), (4, 4))), 0.04)
    assert planes.labels.shape == (1000, 1000) and (planes.labels >= 0).mean() > 0.95


def test_no_maps_have_no_planes():
    assert segment(torch.zeros(0, 5, 4), 0.1) == []


def test_gradients_and_inputs_are_left_alone():
    elevation = noisy(stairs(0.1)).requires_grad_()
    before = elevation.detach().clone()
    assert len(segment(elevation, 0.1)[0].regions) == TREADS + 1
    assert torch.equal(elevation.detach(), before)


@pytest.mark.parametrize(
    "arguments, error, match",
    [
        ((np.zeros((5, 5)), 0.1), TypeError, "elevation: must be a tensor of floats, got float64"),
        ((torch.zeros(5, 5, dtype=torch.int64), 0.1), TypeError, "elevation"),
        ((torch.zeros(5), 0.1), ValueError, r"elevation: must be \(B, H, W\) or \(H, W\), got \(5,\)"),
        ((torch.zeros(1, 0, 5), 0.1), ValueError, "elevation"),
        ((torch.zeros(5, 5), 0.0), ValueError, "resolution"),
        ((torch.zeros(5, 5), math.nan), ValueError, "resolution"),
        ((torch.zeros(5, 5), 0.1, None, (1.0,)), ValueError, "center"),
        ((torch.zeros(4, 5, 5), 0.1, None, np.zeros((3, 2))), ValueError, "center"),
        ((torch.zeros(5, 5), 0.1, None, (math.nan, 0.0)), ValueError, "center: must be finite"),
    ],
)
def test_refuses_inputs_that_do_not_fit(arguments, error, match):
    with pytest.raises(error, match=match):
        segment(*arguments)


@pytest.mark.parametrize(
    "field, value",
    [("window", 0), ("max_inclination", 1.6), ("max_roughness", -1), ("max_distance", 0), ("max_curvature", math.nan)]
    + [("min_area", -0.1), ("margin", -0.01), ("margin", math.inf)],
)
def test_refuses_configs_out_of_range(field, value):
    with pytest.raises(ValueError, match=f"planes.{field}"):
        PlaneConfig(**{field: value})


def test_the_scenes_are_what_they_say():
    assert ramp(np.array([-5.0, -2.5, 0.0]), -4, -1, 0.9).tolist() == [0, 0.45, 0.9]
    assert [SCENES[name](0.04).shape for name in SCENES] == [(250, 250)] * 3


@pytest.mark.slow(1)
def test_many_maps_equal_single_ones():
    """More maps than are segmented at a time, some without any plane, each with its own height and place."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*[np.arange(64) * 0.04] * 2, indexing="ij")
    maps = np.stack([0.1 * np.floor(x / rng.uniform(0.3, 0.8)) + 0.05 * np.sin(k * y) + 100 * k for k in range(20)])
    maps[3], maps[17] = np.nan, rng.uniform(size=x.shape)
    maps[rng.random(maps.shape) < 0.02] = np.nan
    centers = rng.uniform(-9, 9, (20, 2))
    together = segment(torch.from_numpy(maps), 0.04, center=centers)
    assert sum(len(planes.regions) for planes in together) > 60
    for height, center, planes in zip(maps, centers, together, strict=True):
        (alone,) = segment(torch.from_numpy(height), 0.04, center=center)
        np.testing.assert_array_equal(planes.labels, alone.labels)
        for region, same in zip(planes.regions, alone.regions, strict=True):
            for a, b in zip(astuple(region), astuple(same), strict=True):
                np.testing.assert_equal(a, b)
