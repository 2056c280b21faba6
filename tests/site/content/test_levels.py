"""Sites with levels: a bridge that one robot saw from its deck and another one from the road below."""

import copy
import re

import numpy as np
import pytest
import torch

from tests.levels.walks import at, line, look, make_map, walk
from tests.site.helpers import fill
from torchelev import LevelsConfig
from torchelev.io.export import load_npz
from torchelev.sim.exact import covered_scenes
from torchelev.site import SiteMap
from torchelev.site.storage.engines import open_store

BRIDGE, DECK, THICKNESS = covered_scenes.bridge(), 12 * covered_scenes.RISE, 0.25
MIDDLE, BESIDE = (0.05, 0.05), (0.05, 1.55)  # [m] on the bridge, and on the road next to it
LEVELS = LevelsConfig(max_levels=3)


@pytest.fixture(scope="module")
def walked():
    """A map of the road, and one of the deck."""
    road, deck = make_map(), make_map()
    walk(road, BRIDGE, line((0.0, -2.0, 0.0), (0.0, 1.0, 0.0), 6))
    walk(deck, BRIDGE, line((-0.8, 0.0, DECK), (0.0, 0.0, DECK), 5))
    return road, deck


@pytest.fixture
def maps(walked):
    """Copies, which a site takes for other robots."""
    return copy.deepcopy(walked)


def read(site, layer, xy=MIDDLE):
    values, valid = site.sample(torch.tensor([xy]), layer, mode="nearest")
    return float(values[0]) if valid[0] else None


def surfaces(site, xy=MIDDLE):
    """Tops of all surfaces, from below."""
    found = (read(site, f"level{k}.elevation", xy) for k in range(site._tiles.levels.others + 1))
    return [value for value in found if value is not None]


def require_bridge(site):
    assert surfaces(site) == pytest.approx([0.0, DECK], abs=0.01)
    assert read(site, "elevation") == pytest.approx(0.0, abs=0.01), "the lowest surface"
    assert read(site, "ceiling") == read(site, "level1.underside") == pytest.approx(DECK - THICKNESS, abs=0.01)
    assert read(site, "clearance") == pytest.approx(DECK - THICKNESS, abs=0.01)
    assert surfaces(site, BESIDE) == pytest.approx([0.0], abs=0.01) and read(site, "ceiling", BESIDE) == np.inf


@pytest.mark.parametrize("is_road_first", [True, False])
def test_road_and_deck_are_both_there_whoever_comes_first(maps, is_road_first):
    site = SiteMap(resolution=0.1, levels=LEVELS)
    for emap in maps if is_road_first else maps[::-1]:
        assert site.merge(emap).offsets.abs().item() < 0.01, "a deck is no drift of the road"
    require_bridge(site)


def test_a_robot_below_and_above_gives_both_at_once():
    emap, site = make_map(2), SiteMap(resolution=0.1, levels=LEVELS)
    for k in range(5):
        below, above = look(BRIDGE, 0.0, -1.5 + 0.5 * k, seed=k), look(BRIDGE, -0.8 + 0.2 * k, 0.0, DECK, seed=k)
        emap.update(*(torch.cat(pair) for pair in zip(below, above, strict=True)), dt=0.2)
    site.merge(emap)
    require_bridge(site)


def test_nothing_counts_twice(maps):
    once, often = (SiteMap(resolution=0.1, levels=LEVELS) for _ in range(2))
    for emap in maps:
        once.merge(emap, align=False)
        for _ in range(3):
            often.merge(emap, align=False)
    for layer in ("variance", "level1.variance", "level1.underside", "level1.elevation"):
        assert read(often, layer) == pytest.approx(read(once, layer), rel=1e-5), layer


def test_what_a_robot_measures_again_replaces_its_share(maps):
    (road, _), site, first = maps, SiteMap(resolution=0.1, levels=LEVELS), at(maps[0], "variance", *MIDDLE, level=1)
    for place in line((0.0, 1.0, 0.0), (0.0, 1.5, 0.0), 4):
        site.merge(road)
        own, underside = (at(road, layer, *MIDDLE, level=1) for layer in ("variance", "underside"))
        assert read(site, "level1.variance") == pytest.approx(own, rel=0.01)
        assert read(site, "level1.underside") == pytest.approx(underside, abs=1e-3)
        walk(road, BRIDGE, [place])
    assert own < 0.6 * first, "it was measured again"


def test_two_robots_are_twice_as_sure(walked):
    site, road = SiteMap(resolution=0.1, levels=LEVELS), walked[0]
    site.merge(copy.deepcopy(road), align=False)
    alone = read(site, "level1.variance")
    site.merge(copy.deepcopy(road), align=False)
    assert read(site, "level1.variance") == pytest.approx(alone / 2, rel=0.01)


def test_a_ceiling_that_its_robot_has_cleared_goes(maps):
    (road, _), site = maps, SiteMap(resolution=0.1, levels=LEVELS)
    site.merge(road)
    assert len(surfaces(site)) == 2
    road.levels.support.zero_()
    site.merge(road)
    assert surfaces(site) == pytest.approx([0.0], abs=0.01)


def test_a_ceiling_that_another_robot_has_seen_since_stays(maps, walked):
    (road, _), site = maps, SiteMap(resolution=0.1, levels=LEVELS)
    site.merge(road, time=0.0)
    site.merge(copy.deepcopy(walked[0]), time=10.0)
    road.levels.support.zero_()
    site.merge(road, time=20.0)
    assert len(surfaces(site)) == 2


def test_a_crate_on_open_ground_goes_with_its_robot():
    """Known ground, and another robot that saw the top of a crate there, which is higher than the gap."""
    site, first, second = SiteMap(resolution=0.1, levels=LEVELS), make_map(), make_map()
    first.levels.is_open.fill_(True)
    site.merge(fill(first, [[-30, -30]], lambda x, y: 0.0 * x), align=False)
    site.merge(fill(second, [[-30, -30]], lambda x, y: torch.full_like(x, 0.6)), align=False)
    assert surfaces(site) == pytest.approx([0.0, 0.6], abs=1e-3)
    site.merge(fill(second, [[-30, -30]], lambda x, y: 0.0 * x), align=False)
    assert surfaces(site) == pytest.approx([0.0], abs=1e-3)


def test_heights_of_a_wall_contradict_each_other():
    """Nobody knows that the space between them is free."""
    site = SiteMap(resolution=0.1, levels=LEVELS)
    for height in (0.0, 2.0):
        site.merge(fill(make_map(), [[-30, -30]], lambda x, y, z=height: torch.full_like(x, z)), align=False)
    assert len(surfaces(site)) == 1 and {read(site, "elevation"), read(site, "other_elevation")} == {0.0, 2.0}


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("layer", ["ceiling", "clearance"])
def test_samples_take_the_lowest_ceiling_around(layer, mode):
    """A table over half of the cells, next to free ones."""
    emap = fill(make_map(), [[-30, -30]], lambda x, y: 0.1 + 0.0 * x)
    levels = emap.levels.in_windows(emap.state)
    levels.free_top.fill_(3.0)
    for name, value in (("lower", 0.7), ("upper", 0.75), ("variance", 1e-4), ("support", 20.0)):
        getattr(levels, name)[:, 0, :30] = value
    emap.levels.put(levels, emap.state)
    site = SiteMap(resolution=0.1, levels=LEVELS)
    site.merge(emap, align=False)
    xy = torch.tensor([[-0.02, 0.32], [0.02, 0.32], [0.07, 0.32], [-0.5, 0.3], [2.98, 0.3], [3.01, 0.3], [3.2, 0.3]])
    values, valid = site.sample(xy, layer, mode=mode)
    expected, is_known = emap.sample(xy[None], layer, mode=mode)
    assert valid.tolist() == is_known[0].tolist()
    assert values.tolist() == pytest.approx(expected[0].tolist(), abs=1e-5)
    assert values[0] == pytest.approx(0.7 if layer == "ceiling" else 0.6) and values[4] == torch.inf


def flat(height, free_top=-torch.inf, std=0.01):
    """A map of level ground, over which rays passed up to a height."""
    emap = fill(make_map(), [[-30, -30]], lambda x, y: torch.full_like(x, height), std=std)
    emap.levels.free_top.fill_(free_top)
    return emap


@pytest.mark.parametrize("is_low_first", [True, False])
def test_space_is_free_above_the_ground_it_was_seen_from(is_low_first):
    """A robot on a platform saw that nothing hangs above it; the site's ground is the one below."""
    site, low, high = SiteMap(resolution=0.1, levels=LEVELS), flat(0.0, std=0.005), flat(2.0, free_top=5.0, std=0.1)
    for emap in (low, high) if is_low_first else (high, low):
        site.merge(emap, align=False)
    assert read(site, "elevation") == pytest.approx(0.0, abs=1e-3)
    assert read(site, "ceiling") is None, "nobody looked from there"
    site.merge(flat(0.1, free_top=1.5), align=False)
    assert read(site, "ceiling") == np.inf


def test_space_is_not_free_above_a_surface_below_the_ground():
    """A robot on a platform knows the ground below; the platform goes, and nobody has looked up from there."""
    site, emap = SiteMap(resolution=0.1, levels=LEVELS), flat(2.0, free_top=5.0)
    levels = emap.levels.in_windows(emap.state)
    for name, value in (("lower", 0.0), ("upper", 0.0), ("variance", 1e-4), ("support", 20.0)):
        getattr(levels, name)[:, 0] = value
    emap.levels.put(levels, emap.state)
    site.merge(emap, align=False)
    assert surfaces(site) == pytest.approx([0.0, 2.0]) and read(site, "ceiling") == pytest.approx(2.0)
    emap.levels.support.zero_()
    emap.levels.free_top.fill_(-torch.inf)
    site.merge(fill(emap, [[-30, -30]], lambda x, y: 0.0 * x), align=False)
    assert surfaces(site) == pytest.approx([0.0])
    assert read(site, "ceiling") is None


def test_space_above_unknown_ground_stays_until_that_is_known():
    site, emap = SiteMap(resolution=0.1, levels=LEVELS), flat(0.0, free_top=5.0)
    emap.state.validity.zero_()
    emap.state.bounded.fill_(True)
    emap.state.upper_bound.fill_(1.0)
    site.merge(emap, align=False)
    assert read(site, "ceiling") == np.inf
    site.merge(flat(0.0), align=False)
    assert read(site, "ceiling") is None


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normals_count_in_maps_of_any_precision(dtype):
    """Heights of level ground that differ by 8 cm contradict each other; on ground of unknown slope they would not."""
    site = SiteMap(resolution=0.1, levels=LEVELS)
    for height in (0.01, 0.09):
        emap = fill(make_map().to(dtype), [[-30, -30]], lambda x, y, z=height: torch.full_like(x, z))
        report = site.merge(emap, align=False)
    assert report.contradictions.item() == report.new_cells.item() == 3600


def test_a_map_gets_its_levels_back_and_each_robot_its_ground(maps):
    site = SiteMap(resolution=0.1, levels=LEVELS)
    for emap in maps:
        site.merge(emap)
    for ground, other in ((0.0, DECK), (DECK, 0.0)):
        newcomer, (points, T_map_sensor, T_map_base) = make_map(), look(BRIDGE, 0.0, 0.0, ground)
        newcomer.initialize_from(site, T_map_base)
        levels = [at(newcomer, "elevation", *MIDDLE, level=k) for k in (0, 1)]
        assert levels == pytest.approx([0.0, DECK], abs=0.01)
        assert at(newcomer, "ceiling", *MIDDLE) == pytest.approx(DECK - THICKNESS, abs=0.01)
        newcomer.update(points, T_map_sensor, T_map_base, dt=0.1)
        assert at(newcomer, "elevation", *MIDDLE) == pytest.approx(ground, abs=0.02), "found by its first update"
        assert at(newcomer, "elevation", *MIDDLE, level=int(other > ground)) == pytest.approx(other, abs=0.02)


def test_what_a_map_got_from_the_site_is_no_measurement(maps):
    site = SiteMap(resolution=0.1, levels=LEVELS)
    for emap in maps:
        site.merge(emap, align=False)
    newcomer, before = make_map(), {name: read(site, name) for name in ("variance", "level1.variance")}
    newcomer.initialize_from(site)
    site.merge(newcomer, align=False)
    assert {name: read(site, name) for name in before} == before


def test_maps_with_and_without_levels_share_a_site(maps):
    road, deck = maps
    site, plain = SiteMap(resolution=0.1, levels=LEVELS), make_map(levels=LevelsConfig(max_levels=1))
    walk(plain, BRIDGE, line((-0.8, 0.0, DECK), (0.0, 0.0, DECK), 5))
    site.merge(plain)
    assert surfaces(site) == pytest.approx([DECK], abs=0.01)
    site.merge(road)
    require_bridge(site)
    ground = make_map(levels=LevelsConfig(max_levels=1))
    ground.initialize_from(site)
    assert at(ground, "elevation", *MIDDLE) == pytest.approx(0.0, abs=0.01)
    without = SiteMap(resolution=0.1)
    without.merge(deck)
    assert read(without, "elevation") == pytest.approx(DECK, abs=0.01), "the ground alone"
    with pytest.raises(KeyError, match="ceiling"):
        read(without, "ceiling")


def test_a_full_cell_keeps_the_surfaces_of_most_points(maps):
    """A site of two levels gets a map of three."""
    (road, _), site = maps, SiteMap(resolution=0.1, levels=LevelsConfig(max_levels=2))
    levels = road.levels.in_windows(road.state)
    for k, (height, support) in enumerate(((1.5, 20.0), (2.5, 40.0))):
        for name, value in (("lower", height), ("upper", height), ("variance", 1e-4), ("support", support)):
            getattr(levels, name)[:, k] = value
    road.levels.put(levels, road.state)
    site.merge(road)
    assert surfaces(site)[1:] == pytest.approx([2.5])


@pytest.mark.parametrize("drift", [0.05, -0.05])
def test_surfaces_follow_the_offset_of_their_robot(maps, drift):
    site = SiteMap(resolution=0.1, levels=LEVELS)
    site.merge(maps[0])
    drifted = copy.deepcopy(maps[0])
    drifted.elevation.add_(drift)
    for name in ("lower", "upper"):
        getattr(drifted.levels, name).add_(drift)
    assert site.merge(drifted).offsets.item() == pytest.approx(drift, abs=0.002)
    for face in ("underside", "elevation"):
        assert read(site, f"level1.{face}") == pytest.approx(DECK - THICKNESS, abs=0.01)


def test_on_disk_and_in_files(maps, tmp_path):
    path = tmp_path / "site"
    with SiteMap(resolution=0.1, path=path, levels=LEVELS) as site:
        for emap in maps:
            site.merge(emap)
    with SiteMap(resolution=0.1, path=path) as site:  # continues with the levels that it has
        require_bridge(site)
        site.merge(maps[0])
    site = SiteMap.open(path, read_only=True)
    require_bridge(site)
    site.export(tmp_path / "site.npz", ["elevation", "ceiling", "clearance", "level1.elevation"])
    saved = load_npz(tmp_path / "site.npz")
    assert np.isfinite(saved.layers["level1.elevation"]).sum() > 100
    assert {"ceiling", "level2.time"} <= site.window((0.0, 0.0), 1.0, 1.0).layers.keys()


def test_a_site_without_levels_has_none_on_disk(maps, tmp_path):
    SiteMap(resolution=0.1, path=tmp_path / "site").merge(maps[0])
    store = open_store(tmp_path / "site", read_only=True)
    assert len(store.layers) == 7 and "levels" not in store.attributes


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"levels": LevelsConfig(max_levels=4)},
            "levels.max_levels: must be 3, as from the first merge on, got 4; leave levels out, or begin another site",
        ),
        ({"levels": LevelsConfig(min_gap=0.8)}, "levels.min_gap: must be 0.4, as from the first merge on, got 0.8"),
        ({"keyframes": True, "levels": LEVELS}, "levels, keyframes and group: exclude each other, got several"),
    ],
)
def test_another_site_is_refused(tmp_path, settings, message):
    path = tmp_path / "site"
    SiteMap(resolution=0.1, path=path, levels=LEVELS).close()
    with pytest.raises(ValueError, match=re.escape(message)):
        SiteMap(resolution=0.1, path=path, **settings)
    SiteMap(resolution=0.1, path=path).close()  # nothing holds its lock


def test_settings_that_a_site_does_not_use_may_differ(tmp_path):
    path = tmp_path / "site"
    SiteMap(resolution=0.1, path=path, levels=LEVELS).close()
    SiteMap(resolution=0.1, path=path, levels=LevelsConfig(max_levels=3, min_support=5.0, max_step=0.2)).close()


def test_levels_are_not_added_later(tmp_path):
    SiteMap(resolution=0.1, path=tmp_path / "site").close()
    message = "levels.max_levels: must be None: the site was begun without, as from the first merge on, got 3"
    with pytest.raises(ValueError, match=re.escape(message)):
        SiteMap(resolution=0.1, path=tmp_path / "site", levels=LEVELS)
    with pytest.raises(TypeError, match="levels: must be a LevelsConfig, got int"):
        SiteMap(resolution=0.1, levels=3)
