"""A site as a whole, against a dense array and against what the maps know."""

import copy

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given

from tests import reference
from tests.helpers import nans, off_borders, pose, seen_from, small_map
from tests.site.helpers import fill, ground, known_cells, limits, live, robots
from torchelev import ElevationMap
from torchelev.site import SiteConfig, SiteMap
from torchelev.site.content.tiles import Tiles


def dense_means(emap):
    """The information-weighted mean of all windows, cell by cell."""
    sums = {}
    for b in range(emap.num_envs):
        for i, j in np.ndindex(*emap.elevation.shape[1:]):
            if emap.state.validity[b, i, j]:
                weight = 1 / float(emap.state.variance[b, i, j])
                cell = (int(emap.corner[b, 0]) + i, int(emap.corner[b, 1]) + j)
                total, moment = sums.get(cell, (0.0, 0.0))
                sums[cell] = total + weight, moment + weight * float(emap.elevation[b, i, j])
    return {cell: (moment / total, 1 / total) for cell, (total, moment) in sums.items()}


def test_a_merge_is_the_weighted_mean_of_all_windows():
    emap = robots([(0, 0), (10, -5), (-70, 40), (100, 100)], cells=(20, 30), noise=0.003, known=0.8)
    site = SiteMap(0.1)
    site.merge(emap, align=False)
    expected = dense_means(emap)
    elevation, variance = (known_cells(site, layer) for layer in ("elevation", "variance"))
    assert elevation.keys() == expected.keys()
    for cell, (height, sigma2) in expected.items():
        assert elevation[cell] == pytest.approx(height, abs=1e-5) and variance[cell] == pytest.approx(sigma2, rel=1e-5)


@pytest.mark.slow(1)
@given(st.permutations(range(5)), st.integers(0, 50))
def test_the_order_of_the_robots_does_not_matter(order, seed):
    rng = np.random.default_rng(seed)
    corners = rng.integers(-40, 40, (5, 2)).tolist()
    emap = robots(corners, cells=(24, 24), offsets=rng.uniform(-0.1, 0.1, 5), noise=0.005, known=0.9, seed=seed)
    other = small_map(5, (24, 24))
    with torch.no_grad():
        for name, value in emap.state._asdict().items():
            if name != "statistics":
                getattr(other.state, name).copy_(value[list(order)])
    sites = SiteMap(0.1), SiteMap(0.1)
    reports = [site.merge(m) for site, m in zip(sites, (emap, other), strict=True)]
    torch.testing.assert_close(reports[0].offsets[list(order)], reports[1].offsets, atol=1e-6, rtol=0.0)
    for layer in ("elevation", "variance", "other_elevation"):
        a, b = (known_cells(site, layer) for site in sites)
        assert a.keys() == b.keys() and all(a[cell] == pytest.approx(b[cell], abs=1e-5) for cell in a)


def test_merging_twice_without_a_new_measurement_changes_no_bit():
    emap = robots([(0, 0), (20, 10)], noise=0.003)
    site = SiteMap(0.1)
    site.merge(emap)
    before = {layer: known_cells(site, layer) for layer in ("elevation", "variance")}
    report = site.merge(emap)
    assert not report.new_cells.any()
    assert before == {layer: known_cells(site, layer) for layer in ("elevation", "variance")}


def test_merging_later_without_a_new_measurement_only_ages():
    emap = robots([(0, 0)])
    site = SiteMap(0.1)
    site.merge(emap)
    live(emap, 100.0)
    site.merge(emap)
    assert site.time == pytest.approx(100.0)
    rate = emap.cfg.aging.variance_rate
    assert limits(site, "variance") == pytest.approx(2 * [1e-4 + 100 * rate], rel=1e-4)
    assert limits(site, "time") == pytest.approx(2 * [100.0])


def test_a_site_of_one_robot_is_its_map_however_often_it_is_merged():
    rng = np.random.default_rng(3)
    emap, site = small_map(1, (16, 16), drift=None), SiteMap(0.1)
    T = pose((0.1, 0.2, 1.2))
    for _ in range(6):
        for _ in range(3):
            xy = off_borders(rng.uniform(-0.9, 0.9, (150, 2)), 0.1)
            points = np.column_stack([xy, 0.1 * xy[:, 0] + rng.normal(0, 0.003, 150)])
            emap.update(seen_from(T, points, torch.float32), T, dt=0.1)
        site.merge(emap, align=False)
    for layer in ("elevation", "variance", "time"):
        window = site.window((0.0, 0.0), 1.6, 1.6, [layer]).layers[layer]
        expected = emap.layer(layer)[0].numpy()
        known = np.isfinite(expected)
        assert known.mean() > 0.5
        np.testing.assert_allclose(window[known], expected[known], rtol=1e-4, atol=1e-6)


def test_what_leaves_the_window_stays_in_the_site():
    emap, site = robots([(0, 0)]), SiteMap(0.1)
    site.merge(emap)
    fill(emap, [(500, 0)])
    emap.state.elapsed.add_(10**9)
    site.merge(emap)
    value, valid = site.sample([[1.0, 1.0], [51.0, 1.0]])
    assert valid.all()
    torch.testing.assert_close(value, ground(*torch.tensor([[1.0, 51.0], [1.0, 1.0]])), atol=2e-3, rtol=0.0)


def test_a_robot_that_was_reset_measures_independently():
    emap, site = robots([(0, 0)]), SiteMap(0.1)
    live(emap, 5.0)
    site.merge(emap)
    emap.reset()
    fill(emap, [(0, 0)])
    site.merge(emap)
    assert limits(site, "variance") == pytest.approx(2 * [0.5e-4], rel=0.05)


def test_a_changed_place_is_kept_apart_and_reported():
    emap, site = robots([(0, 0)], std=0.003), SiteMap(0.1)
    site.merge(emap)
    box = robots([(0, 0)], std=0.003)
    box.state.elevation[0, 10:20, 10:20] += 0.5
    box.state.elapsed.add_(60 * 10**9)
    report = site.merge(box)
    assert report.contradictions.tolist() == [100]
    value, other = (site.sample([[1.55, 1.55]], layer, "nearest")[0] for layer in ("elevation", "other_elevation"))
    assert float(value - other) == pytest.approx(0.5, abs=1e-3)


def test_a_single_scan_replaces_well_known_ground_after_the_age_that_the_guide_says():
    for age, wins in ((239.0, False), (241.0, True)):  # [s] (1 cm^2 / 4 - 1 mm^2) / 1e-7 m^2/s = 240 s
        site = SiteMap(0.1)
        site.merge(robots([(0, 0)], std=0.001), time=0.0)
        site.merge(robots([(0, 0)], std=0.01, heights=lambda x, y: ground(x, y) + 0.5), time=age, align=False)
        value, _ = site.sample([[1.55, 1.55]], mode="nearest")
        assert (float(value) > float(ground(torch.tensor(1.55), torch.tensor(1.55))) + 0.4) == wins


def test_the_first_merge_fixes_the_heights():
    corners, errors = [(0, 0), (20, 0)], [0.1, 0.3]
    batch, one_by_one = SiteMap(0.1), SiteMap(0.1)
    report = batch.merge(robots(corners, offsets=errors))
    assert report.offsets.tolist() == pytest.approx([-0.1, 0.1], abs=1e-3) and not report.is_isolated.any()
    reports = [
        one_by_one.merge(robots([corner], offsets=[error])) for corner, error in zip(corners, errors, strict=True)
    ]
    assert [float(report.offsets) for report in reports] == pytest.approx([0.0, 0.2], abs=1e-3)
    assert [bool(report.is_isolated) for report in reports] == [True, False]
    heights = [float(site.sample([[0.55, 0.55]], mode="nearest")[0]) for site in (batch, one_by_one)]
    true = float(ground(torch.tensor(0.55), torch.tensor(0.55)))
    assert heights == pytest.approx([true + 0.2, true + 0.1], abs=1e-3)


def test_a_bilinear_sample_mixes_across_a_contradiction_and_the_nearest_does_not():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)], heights=lambda x, y: 0.0 * x, std=0.003))
    crate = robots([(0, 0)], heights=lambda x, y: 0.5 * (x > 1.0), std=0.003)
    site.merge(crate, time=site.time + 60.0, align=False)
    heights = [float(site.sample([[1.02, 1.0]], mode=mode)[0]) for mode in ("bilinear", "nearest")]
    assert heights == pytest.approx([0.35, 0.5], abs=1e-3)


def test_the_extent_is_that_of_the_tiles():
    site = SiteMap(0.1)
    assert site.extent == (0.0, 0.0, 0.0, 0.0)
    site.merge(robots([(-10, 50)]))
    assert site.extent == pytest.approx((-6.4, 6.4, 0.0, 12.8))


def test_upper_bounds_are_the_lowest_and_end_where_the_ground_is_known():
    emap = small_map(2, (8, 8))
    emap.corner.copy_(torch.tensor([[0, 0], [0, 0]]))
    emap.state.bounded.fill_(True)
    emap.state.upper_bound.copy_(torch.tensor([0.4, 0.3])[:, None, None].expand(2, 8, 8))
    site = SiteMap(0.1)
    site.merge(emap)
    assert limits(site, "upper_bound") == pytest.approx(2 * [0.3])
    assert not known_cells(site, "elevation")
    fill(emap, [(0, 0), (0, 0)], lambda x, y: 0.0 * x)
    emap.state.elapsed.add_(10**9)
    site.merge(emap)
    assert set(known_cells(site, "upper_bound").values()) == {0.0}


@pytest.mark.parametrize("mode", ["nearest", "bilinear"])
def test_samples_are_those_of_the_reference(mode):
    emap = robots([(-30, -8)], cells=(60, 50), known=0.7)
    site = SiteMap(0.1)
    site.merge(emap)
    xy = np.random.default_rng(0).uniform(-4, 5, (300, 2))
    values, valid = site.sample(torch.from_numpy(xy), mode=mode)
    layer, known = emap.elevation[0].double().numpy(), emap.state.validity[0].numpy()
    for k, (x, y) in enumerate(xy):
        expected = reference.sample(layer, known, x, y, (-30, -8), 0.1, mode)
        assert (float(values[k]), bool(valid[k])) == (pytest.approx(expected[0], abs=1e-5), expected[1])


def test_samples_far_away_and_of_no_place_are_not_valid():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    values, valid = site.sample([[1e8, -1e8], [float("nan"), 0.0], [1.0, 1.0]])
    assert valid.tolist() == [False, False, True] and values[:2].tolist() == [0.0, 0.0]


def test_a_window_lines_up_with_the_lattice():
    emap = robots([(3, -7)])
    site = SiteMap(0.1)
    site.merge(emap)
    window = site.window((2.31, 1.12), 4.0, 3.6)
    assert window.center[:2] == pytest.approx([2.3, 1.1]) and window.layers["elevation"].shape == (40, 36)
    np.testing.assert_allclose(window.layers["elevation"], emap.elevation[0], atol=1e-6)


def test_a_site_100_km_away_is_as_precise():
    far = 1_000_000
    emap = robots([(far, -far)])
    site = SiteMap(0.1)
    site.merge(emap)
    xy = emap.cell_centers()[0].flatten(0, 1)
    values, valid = site.sample(xy, mode="nearest")
    assert valid.all()
    torch.testing.assert_close(values, emap.elevation[0].flatten(), atol=0.0, rtol=1e-6)


def test_samples_of_a_site_on_disk_read_what_memory_has_no_room_for(tmp_path):
    emap = robots([(0, 0), (500, 0), (1000, 0)])
    with SiteMap(0.1, tmp_path / "site", cfg=SiteConfig(cache_tiles=1)) as site:
        site.merge(emap)
        site.refresh()
        values, valid = site.sample(emap.cell_centers()[:, 7, 9], mode="nearest")
    assert valid.all()
    torch.testing.assert_close(values, emap.elevation[:, 7, 9])


# Times ----------------------------------------------------------------------------------------------------------------


def test_a_time_before_the_newest_is_reported_and_counts_as_that_old():
    sites, maps = [SiteMap(0.1), SiteMap(0.1)], [robots([(0, 0)]), robots([(10, 0)], std=0.02)]
    sites[0].merge(maps[1], time=500.0)
    sites[0].merge(maps[0], time=1000.0)
    sites[1].merge(maps[0], time=1000.0)
    with pytest.warns(
        RuntimeWarning, match=r"^time: .* got 500\.000, 500\.000 s before the site's .*; give all"
    ) as warned:
        sites[1].merge(maps[1], time=500.0)
    assert warned[0].filename == __file__
    for layer in ("elevation", "variance", "time"):
        expected, actual = (known_cells(site, layer) for site in sites)
        assert actual == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert [site.time for site in sites] == [1000.0, 1000.0]


def test_clocks_that_are_mixed_are_reported():
    site, emap = SiteMap(0.1), robots([(0, 0)])
    live(emap, 5.0)
    site.merge(emap)
    with pytest.warns(RuntimeWarning, match=r"time: .* got 1764143370\.000, 1764143365\.000 s after the site's newest"):
        site.merge(emap, time=1764143370.0)


def test_times_of_one_clock_are_not_reported(recwarn):
    site, emap = SiteMap(0.1), small_map(1, (40, 36))
    live(emap, 10.0)
    site.merge(emap)  # knows nothing yet: the first time that is given starts the clock
    fill(emap, [(0, 0)])
    for time in (0.1, 1.1, 1764.3, 1764.3):
        site.merge(emap, time=time)
        assert site.time == pytest.approx(time)
    site.merge(emap)
    before_zero = SiteMap(0.1)
    for time in (-999.1, 4.6, 4.6):  # whose difference float64 rounds
        before_zero.merge(emap, time=time)
    assert not recwarn.list


@pytest.mark.parametrize(
    ("time", "error", "text"),
    [
        ("x", TypeError, "time: must be a number of seconds, got 'x'; give a float"),
        (True, TypeError, "time: must be a number of seconds, got True"),
        (float("nan"), ValueError, "time: must be a finite number, got nan"),
        (1764143370123456789, ValueError, r"time: must be in seconds, .* got 1\.76414e\+18; convert it: nanoseconds"),
    ],
)
def test_times_that_are_no_seconds_are_refused(time, error, text):
    site, emap = SiteMap(0.1), robots([(0, 0)])
    with pytest.raises(error, match=text):
        site.merge(emap, time=time)
    assert not len(site) and site.time == 0.0


# Giving back ----------------------------------------------------------------------------------------------------------


def test_a_robot_that_comes_back_starts_with_what_is_known():
    first, site = robots([(0, 0)]), SiteMap(0.1)
    live(first, 50.0)
    site.merge(first)
    emap = small_map(2, (20, 20))
    poses = pose((2.0, 1.8, 0.5), num_envs=2)
    emap.initialize_from(site, poses, env_ids=torch.tensor([1]))
    assert not emap.state.validity[0].any() and emap.state.validity[1].all()
    xy = emap.cell_centers()[1]
    torch.testing.assert_close(emap.layer("elevation")[1], ground(xy[..., 0], xy[..., 1]).float(), atol=1e-5, rtol=0.0)
    expected = 1e-4 + 50 * first.cfg.aging.variance_rate
    assert emap.layer("variance")[1].unique().tolist() == pytest.approx([expected], rel=1e-4)
    assert emap.layer("time")[1].unique().tolist() == pytest.approx([50.0])
    assert emap.layer("traversability")[1].isfinite().any()


def test_what_was_given_does_not_come_back_as_a_measurement():
    first, site = robots([(0, 0)]), SiteMap(0.1)
    site.merge(first)
    before = known_cells(site, "variance")
    emap = small_map(1, (20, 20))
    emap.initialize_from(site, pose((2.0, 1.8, 0.5)))
    site.merge(emap)
    assert known_cells(site, "variance") == pytest.approx(before, rel=1e-5)
    emap.update(nans(1), pose((2.0, 1.8, 0.5)), pose((2.0, 1.8, 0.5)), dt=1.0)
    site.merge(emap)
    aged = {cell: value + emap.cfg.aging.variance_rate for cell, value in before.items()}
    assert known_cells(site, "variance") == pytest.approx(aged, rel=1e-4)


def test_what_two_robots_were_given_still_counts_once():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    before = known_cells(site, "variance")
    emap = small_map(2, (20, 20))
    emap.initialize_from(site, pose((2.0, 1.8, 0.5), num_envs=2))
    site.merge(emap)
    assert known_cells(site, "variance") == pytest.approx(before, rel=1e-5)


def test_measured_cells_are_not_overwritten():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    emap = robots([(0, 0)], offsets=[0.3], known=0.5)
    measured, mask = emap.layer("elevation"), emap.state.validity.clone()
    emap.initialize_from(site)
    torch.testing.assert_close(emap.layer("elevation")[mask], measured[mask])
    assert emap.state.validity.all()


def test_a_mask_chooses_the_environments():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    emap = fill(small_map(2, (20, 20)), [(0, 0), (0, 0)], known=0.0)
    emap.initialize_from(site, mask=torch.tensor([True, False]))
    assert emap.state.validity.flatten(1).any(1).tolist() == [True, False]


def test_a_copy_of_a_map_is_another_robot():
    emap, site = robots([(0, 0)]), SiteMap(0.1)
    site.merge(emap)
    site.merge(copy.deepcopy(emap))
    assert limits(site, "variance") == pytest.approx(2 * [0.5e-4])


# Bad input ------------------------------------------------------------------------------------------------------------


def test_bad_arguments_are_refused_by_name():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    before = known_cells(site)
    with pytest.raises(ValueError, match=r"emap: must have the site's resolution, 0\.1 m, got 0\.05 m"):
        site.merge(small_map(1, resolution=0.05))
    with pytest.raises(TypeError, match="emap: must be an ElevationMap, got str"):
        site.merge("map")
    with pytest.raises(ValueError, match="resolution: must be a positive number"):
        SiteMap(0.0)
    with pytest.raises(KeyError, match="layer: must be one of elevation, variance, .* validity, got 'height'; check"):
        site.sample([[0.0, 0.0]], "height")
    with pytest.raises(KeyError, match="layers: must be one of elevation, .*, got 'height'"):
        site.window((0.0, 0.0), 1.0, 1.0, ["time", "height"])
    with pytest.raises(TypeError, match=r"layers: must be a list of names, got 'time'; give \['time'\]"):
        site.window((0.0, 0.0), 1.0, 1.0, "time")
    with pytest.raises(ValueError, match=r"xy: expected \(M, 2\)"):
        site.sample([[0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="mode"):
        site.sample([[0.0, 0.0]], mode="cubic")
    with pytest.raises(
        ValueError, match=r"^length_x: must be a whole number of times 0\.1 m, got 1\.23 times; try 0\.1"
    ):
        site.window((0.0, 0.0), 0.123, 1.0)
    with pytest.raises(ValueError, match="^length_y: must be a positive number"):
        site.window((0.0, 0.0), 1.0, 0.0)
    for center in ((0.0,), (0.0, float("nan"))):
        with pytest.raises(
            ValueError, match=r"center: expected x, y in metres, got \[0\.0.*\]; give \(0\.0, 0\.0\), say"
        ):
            site.window(center, 1.0, 1.0)
    with pytest.raises(ValueError, match="emap: must have the site's resolution"):
        small_map(1, resolution=0.05).initialize_from(site)
    with pytest.raises(TypeError, match="site: must be a SiteMap, got str"):
        ElevationMap().initialize_from("site")
    assert known_cells(site) == before


def test_inference_mode_leaves_nothing_that_cannot_be_written_later():
    emap, site = robots([(0, 0), (20, 0)], offsets=[0.1, -0.1]), SiteMap(0.1)
    with torch.inference_mode():
        site.merge(emap)
    fill(emap, [(0, 0), (20, 0)])
    emap.state.elapsed.add_(10**9)
    report = site.merge(emap)
    report.offsets.sub_(report.offsets.mean())
    site.sample([[1.0, 1.0]])[0].add_(1.0)
    emap.initialize_from(site)


def test_maps_of_half_precision_merge_as_precisely_as_they_are():
    exact, half = robots([(0, 0), (20, 0)], offsets=[0.1, -0.1]), robots([(0, 0), (20, 0)], offsets=[0.1, -0.1])
    sites = SiteMap(0.1), SiteMap(0.1)
    offsets = [site.merge(emap).offsets for site, emap in zip(sites, (exact, half.to(torch.bfloat16)), strict=True)]
    torch.testing.assert_close(*offsets, atol=2e-3, rtol=0.0)
    a, b = (known_cells(site) for site in sites)
    assert a == pytest.approx(b, abs=5e-3)


# What a review found --------------------------------------------------------------------------------------------------


def test_a_read_that_fails_leaves_no_garbage_in_the_cache():
    class Broken:
        tiles = frozenset([(0, 0)])

        def read(self, tiles):
            raise OSError("damaged")

    cache = Tiles(Broken(), 4, "cpu")
    for _ in range(2):
        with pytest.raises(OSError, match="damaged"):
            cache.read([(0, 0)])


def test_given_cells_are_not_new_and_do_not_contradict_a_site_that_has_changed():
    site, first = SiteMap(0.1), robots([(0, 0)], std=0.003)
    site.merge(first)
    newcomer = small_map(1, (20, 20))
    newcomer.initialize_from(site, pose((2.0, 1.8, 0.5)))
    box = robots([(0, 0)], std=0.003, offsets=[0.5])
    site.merge(box, align=False)
    report = site.merge(newcomer, align=False)
    assert not report.new_cells.any() and not report.contradictions.any()
    value, _ = site.sample([[1.55, 1.55]], mode="nearest")
    assert float(value) == pytest.approx(float(box.elevation[0, 15, 15]), abs=1e-5)


def test_measured_cells_that_are_not_merged_yet_still_count_once_after_initialize_from():
    sites, maps = [SiteMap(0.1), SiteMap(0.1)], [robots([(0, 0)], cells=(20, 20)) for _ in range(2)]
    for k, (site, emap) in enumerate(zip(sites, maps, strict=True)):
        site.merge(emap, align=False)
        emap.state.elapsed.add_(10**9)
        emap.state.variance.mul_(0.5)
        emap.state.elevation.add_(1e-3)
        if k:
            emap.initialize_from(site)
        site.merge(emap, align=False)
    assert known_cells(sites[0], "variance") == pytest.approx(known_cells(sites[1], "variance"))
    assert limits(sites[1], "variance") == pytest.approx([0.5e-4, 0.5e-4])


def test_a_robot_keeps_its_offset_where_it_shares_no_ground():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    emap = robots([(10, 0)], offsets=[0.5])
    site.merge(emap)
    fill(emap, [(1000, 0)], offsets=[0.5])
    emap.state.elapsed.add_(10**9)
    report = site.merge(emap)
    assert bool(report.is_isolated) and float(report.offsets) == pytest.approx(0.5, abs=1e-3)


@pytest.mark.slow(7)
def test_many_windows_are_aligned_too():
    corners = [(12 * (k % 50), 12 * (k // 50)) for k in range(2000)]
    offsets = torch.linspace(-0.2, 0.2, 2000)
    report = SiteMap(0.1).merge(robots(corners, cells=(24, 24), offsets=offsets))
    assert not report.is_isolated.any()
    error = report.offsets - offsets
    assert float((error - error.mean()).abs().max()) < 2e-3


def test_a_map_that_loads_an_earlier_state_is_merged_on():
    site, emap = SiteMap(0.1), robots([(0, 0)])
    early = {name: value.clone() for name, value in emap.state_dict().items() if name != "_extra_state"}
    emap.state.elapsed.add_(10**9)
    site.merge(emap)
    emap.load_state_dict({**early, "_extra_state": emap.get_extra_state()})
    fill(emap, [(100, 0)])
    assert int(site.merge(emap).new_cells) == 40 * 36


def test_the_clocks_of_several_maps_do_not_add_up():
    site, maps = SiteMap(0.1), [robots([(0, 0)]), robots([(10, 0)])]
    for _ in range(10):
        for emap in maps:
            live(emap, 1.0)
            site.merge(emap)
    assert site.time == pytest.approx(10.0)


def test_a_point_absurdly_far_away_does_not_spoil_the_others():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    assert site.sample(torch.tensor([[1e18, 0.0], [1.0, 1.0]], dtype=torch.float64))[1].tolist() == [False, True]


def test_what_was_given_without_a_pose_stays_where_it_was_as_the_window_moves():
    site = SiteMap(0.1)
    site.merge(robots([(-30, -30)], cells=(60, 60)))
    before = known_cells(site, "variance")
    emap = small_map(1, (20, 20))
    emap.initialize_from(site)
    moved = pose((0.7, 0.4, 0.5))
    emap.update(nans(1), moved, moved, dt=1.0)
    report = site.merge(emap)
    assert not report.new_cells.any()
    aged = {cell: value + emap.cfg.aging.variance_rate for cell, value in before.items()}
    assert known_cells(site, "variance") == pytest.approx(aged, rel=1e-4)


def test_a_map_in_double_precision_merges_as_one_in_single():
    single = robots([(0, 0), (10, -5)], cells=(20, 30), known=0.8)
    single.state.bounded.copy_(~single.state.validity)
    double = copy.deepcopy(single).double()
    sites = SiteMap(0.1), SiteMap(0.1)
    for site, emap in zip(sites, (single, double), strict=True):
        site.merge(emap, align=False)
    for layer in ("elevation", "upper_bound"):
        one, other = (known_cells(site, layer) for site in sites)
        assert one and one.keys() == other.keys()
        assert all(other[cell] == pytest.approx(value, abs=1e-6) for cell, value in one.items())
