"""Channels of a site: what of a robot's evidence is in there, when it was measured, and what is taken out again."""

import json

import numpy as np
import pytest
import torch

from tests.helpers import pose, small_map
from torchelev import ChannelConfig
from torchelev.site import SiteMap
from torchelev.site.channels import SiteChannels
from torchelev.site.storage.store import TileStore
from torchelev.site.tiles import LAYERS

CELL = [0.05, 0.05]
NAMES, GRASS, STONE = ("grass", "stone"), (1.0, 0.0), (0.0, 1.0)
CHANNELS = {
    "heat": "mean",
    "alarm": "maximum",
    "terrain": ChannelConfig(kind="class", names=("grass", "stone")),
    "wet": ChannelConfig(kind="exponential", rate=1.0),
    "door": ChannelConfig(kind="class_average", names=("open", "shut"), rate=1.0),
}
NEWEST = [("wet", 2.0, 1.0), ("door", (0.0, 1.0), (1.0, 0.0))]  # channel, a value of B, another one of A


def robot(**channels):
    return small_map(channels=channels or CHANNELS)


def see(emap, height=0.0, times=1, dt=0.1, **features):
    """Let a robot see one point of a height [m], with features, so many times."""
    cloud = torch.tensor([[[*CELL, height - 1.0]]])
    for _ in range(times):
        values = {name: torch.tensor(value).view(1, 1, -1) for name, value in features.items()}
        emap.update(cloud, pose(), pose(), dt=dt, features=values)


def value(site, layer):
    values, valid = site.sample(torch.tensor([CELL]), layer, mode="nearest")
    return float(values[0]) if valid[0] else None


def counts(site):
    """Points that the site holds of grass, and of stone; the prior is one point of both together."""
    weight = stored(site, "terrain/weight")
    return None if np.isnan(weight) else [round(value(site, f"terrain.{n}") * (weight + 1) - 0.5, 3) for n in NAMES]


def stored(site, layer):
    """A layer of the tiles, at the cell."""
    row, tile = site._tiles.layers.index(layer), site._tiles.read([(0, 0)])
    return float(tile[row, 0, 0, 0])


def stored_layers(path):
    return json.loads((path / "zarr.json").read_text())["attributes"]["layers"]


@pytest.mark.parametrize(("channel", "newer", "older"), NEWEST)
def test_an_older_value_that_is_merged_later_does_not_win(channel, newer, older):
    A, B, site = robot(), robot(), SiteMap(resolution=0.1, channels=CHANNELS)
    layer = "wet" if channel == "wet" else "door.open"
    expected = newer if channel == "wet" else newer[0]
    see(A, **{channel: older})
    site.merge(A, align=False, time=50.0)
    see(A, dt=1.0, **{channel: older})  # at 51 s
    see(B, **{channel: newer})
    site.merge(B, align=False, time=100.0)
    A.update(torch.full((1, 1, 3), torch.nan), pose(), pose(), dt=50.0)
    site.merge(A, align=False, time=101.0)
    assert value(site, layer) == pytest.approx(expected)
    site.merge(A, align=False, time=102.0)
    assert value(site, layer) == pytest.approx(expected)
    see(A, dt=2.0, **{channel: older})  # now it is the newest
    site.merge(A, align=False, time=104.0)
    assert value(site, layer) == pytest.approx(older if channel == "wet" else older[0])


def test_ground_that_is_seen_again_makes_no_value_newer():
    """A saw wet ground at 1 s and was not believed; its ground is seen anew, without a value."""
    A, B, C = robot(), robot(), small_map()
    site = SiteMap(resolution=0.1, channels=CHANNELS)
    see(C, times=40)
    site.merge(C, align=False, time=0.5)
    see(A, height=0.08, wet=1.0)
    site.merge(A, align=False, time=1.0)
    assert value(site, "wet") is None, "not the ground that the site shows"
    see(B, wet=2.0)
    site.merge(B, align=False, time=2.0)
    see(A, times=8)
    site.merge(A, align=False, time=3.0)
    assert value(site, "wet") == 2.0


def test_other_ground_brings_its_own_value_though_it_is_older():
    """B saw a crate's height once, at 100 s; A the ground below very often, at 51 s, which is surer."""
    A, B, site = robot(), robot(), SiteMap(resolution=0.1, channels=CHANNELS)
    see(B, height=0.4, wet=2.0)
    site.merge(B, align=False, time=100.0)
    see(A, times=60, wet=1.0)
    with pytest.warns(RuntimeWarning, match="not go back"):
        site.merge(A, align=False, time=51.0)
    assert value(site, "elevation") == pytest.approx(0.0, abs=0.01) and value(site, "wet") == 1.0


def paint(emap, number, channel="wet"):
    """Let a camera that looks down see a number everywhere."""
    T = torch.eye(4)[None]
    T[0, :3] = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]])
    K = torch.tensor([[10.0, 0.0, 9.5], [0.0, 10.0, 9.5], [0.0, 0.0, 1.0]])
    emap.paint(torch.full((1, 1, 20, 20), number), K, T, channel)


def test_an_image_of_ground_that_was_measured_before_is_the_newest():
    A, B, site = robot(), robot(), SiteMap(resolution=0.1, channels=CHANNELS)
    see(A, wet=1.0)
    site.merge(A, align=False, time=1.0)
    see(B, wet=2.0)
    site.merge(B, align=False, time=2.0)
    A.update(torch.full((1, 1, 3), torch.nan), pose(), pose(), dt=2.0)
    site.merge(A, align=False, time=3.0)
    paint(A, 5.0)
    A.update(torch.full((1, 1, 3), torch.nan), pose(), pose(), dt=1.0)
    site.merge(A, align=False, time=4.0)
    assert value(site, "wet") == 5.0


def test_being_initialised_makes_no_value_newer():
    """A measured at 20 s, before B at 30 s; then it is given the site's heights, and merges."""
    A, B, site = robot(), robot(), SiteMap(resolution=0.1, channels=CHANNELS)
    see(A, wet=1.0)
    site.merge(A, align=False, time=10.0)
    see(A, dt=10.0, wet=3.0)
    see(B, wet=2.0)
    site.merge(B, align=False, time=30.0)
    A.update(torch.full((1, 1, 3), torch.nan), pose(), pose(), dt=11.0)
    A.initialize_from(site)
    site.merge(A, align=False, time=31.0)
    assert value(site, "wet") == 2.0


def test_with_a_max_age_it_is_the_value_whose_time_counts():
    wet = {"wet": ChannelConfig(kind="exponential", rate=1.0, max_age=60.0)}
    A, B, site = robot(**wet), robot(**wet), SiteMap(resolution=0.1, channels=wet)
    see(A, wet=1.0)
    see(A, dt=10.0)  # the ground alone
    see(B, wet=2.0)
    see(B, dt=5.0)
    site.merge(B, align=False, time=20.0)  # of 15 s
    site.merge(A, align=False, time=20.0)  # of 10 s
    assert value(site, "wet") == 2.0


def drifted(site):
    """B gave 4 points of grass; A's 3 of stone did not count, until the site's height came nearer. Return A."""
    A, B, C = robot(), robot(), small_map()
    see(C, height=0.0, times=30)
    see(B, height=0.0, times=4, terrain=GRASS, heat=2.0)
    site.merge(B, align=False)
    site.merge(C, align=False)
    see(A, height=0.06, times=3, terrain=STONE, heat=9.0)
    site.merge(A, align=False)
    assert counts(site) == [4.0, 0.0] and value(site, "elevation") < 0.01
    C.reset()
    see(C, height=0.03, times=60)
    site.merge(C, align=False)
    assert 0.011 < value(site, "elevation") < 0.04 and counts(site) == [4.0, 0.0]
    return A


def folder_without(path):
    """A folder of a site that does not say since when its cells hold what they do."""
    channels = SiteChannels(CHANNELS, LAYERS)
    layers = (*LAYERS, *(layer for name in CHANNELS for layer in channels.sources(name)))
    attributes = {"resolution": 0.1, "channels": channels.attributes}
    TileStore.create(path, layers=layers, tile_size=64, attributes=attributes).close()
    return path


@pytest.mark.parametrize("on_disk", [False, pytest.param(True, marks=pytest.mark.slow(1))])
def test_what_was_not_given_is_not_taken_out(tmp_path, on_disk):
    path = folder_without(tmp_path / "site") if on_disk else None
    site = SiteMap(resolution=0.1, path=path, channels=CHANNELS)
    A = drifted(site)
    see(A, height=0.06, terrain=STONE, heat=9.0)
    for _ in range(2):
        site.merge(A, align=False)
        assert counts(site) == [4.0, 4.0]
        # Points that are nearer to the sensor weigh more.
        assert value(site, "heat") == pytest.approx((4 * 2.0 + 4 * 9.0) / 8, abs=0.2)


def test_what_was_not_given_is_given_once_the_ground_fits():
    site = SiteMap(resolution=0.1, channels=CHANNELS)
    A = drifted(site)
    for _ in range(2):
        site.merge(A, align=False)
        assert counts(site) == [4.0, 3.0]


def test_what_was_given_is_taken_out_though_the_height_has_drifted():
    """The site's height moves away from A's share by more than the tolerance, in two steps within it."""
    A, C, site = robot(), small_map(), SiteMap(resolution=0.1, channels=CHANNELS)
    see(A, times=3, terrain=STONE)
    site.merge(A, align=False)
    for height in (0.045, 0.08):
        C.reset()
        see(C, height=height, times=100)
        site.merge(C, align=False)
        assert counts(site) == [0.0, 3.0]
    assert value(site, "elevation") > 0.06
    for height in (0.04, 0.07):  # A's own map follows, and keeps its points
        see(A, height=height, times=100)
    see(A, height=0.07, terrain=STONE)
    site.merge(A, align=False)
    assert counts(site) == [0.0, 4.0]


def rebuild(site):
    """A crate comes and goes, which robots without channels see: the cell forgets twice."""
    for height in (0.4, 0.0):
        C = small_map()
        see(C, height=height, times=60)
        for _ in range(3):
            site.merge(C, align=False, time=site.time + 3600.0)
        assert value(site, "elevation") == pytest.approx(height, abs=0.02)
    assert value(site, "terrain.grass") is None and np.isnan(stored(site, "terrain/merge"))


@pytest.mark.parametrize("on_disk", [False, pytest.param(True, marks=pytest.mark.slow(1))])
def test_what_the_site_forgot_is_not_taken_out(tmp_path, on_disk):
    path = tmp_path / "site" if on_disk else None
    A, B, site = robot(), robot(), SiteMap(resolution=0.1, path=path, channels=CHANNELS)
    see(A, times=3, terrain=STONE, heat=9.0)
    site.merge(A, align=False, time=1.0)
    rebuild(site)
    see(B, times=4, terrain=GRASS, heat=2.0)
    site.merge(B, align=False, time=site.time + 1.0)
    if path is not None:
        site.close()
        site = SiteMap(resolution=0.1, path=path)
    see(A, terrain=STONE, heat=9.0)
    for _ in range(2):
        site.merge(A, align=False, time=site.time + 1.0)
        assert counts(site) == [4.0, 4.0]
        assert value(site, "heat") == pytest.approx((4 * 2.0 + 4 * 9.0) / 8, abs=1e-4)
    see(A, terrain=STONE, heat=9.0)  # what it gave since is taken out again
    site.merge(A, align=False, time=site.time + 1.0)
    assert counts(site) == [4.0, 5.0]
    site.close()


def test_evidence_of_before_a_late_merge_is_not_taken_out():
    """The time at which B measured lies before A's; what counts is whether the cell was forgotten since A gave."""
    A, B, site = robot(), robot(), SiteMap(resolution=0.1, channels=CHANNELS)
    see(A, times=3, terrain=STONE)
    site.merge(A, align=False, time=100.0)
    rebuild(site)
    see(B, times=4, terrain=GRASS)
    with pytest.warns(RuntimeWarning, match="not go back"):
        site.merge(B, align=False, time=50.0)
    see(A, terrain=STONE)
    site.merge(A, align=False, time=site.time + 1.0)
    assert counts(site) == [4.0, 4.0]


def test_the_order_of_merges_does_not_matter_for_sums():
    found = []
    for order in ((0, 1), (1, 0)):
        site = SiteMap(resolution=0.1, channels=CHANNELS)
        maps = [robot(), robot()]
        for _ in range(3):
            for k in order:
                label, heat = ((GRASS, 2.0), (STONE, 9.0))[k]
                see(maps[k], times=1 + k, terrain=label, heat=heat, alarm=heat)
                site.merge(maps[k], align=False)
        found.append([*counts(site), value(site, "heat"), value(site, "alarm")])
    np.testing.assert_allclose(found[0], [3.0, 6.0, (3 * 2.0 + 6 * 9.0) / 9, 9.0], rtol=1e-5)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-5)


@pytest.mark.slow(1)
def test_the_time_of_a_value_is_stored(tmp_path):
    A, B, path = robot(), robot(), tmp_path / "site"
    with SiteMap(resolution=0.1, path=path, channels=CHANNELS) as site:
        see(B, wet=2.0, terrain=GRASS)
        site.merge(B, align=False, time=100.0)
        since = [name for name in stored_layers(path) if name.endswith(("/time", "/merge"))]
        assert since == ["heat/merge", "terrain/merge", "wet/time", "door/time"]
    with SiteMap(resolution=0.1, path=path) as site:
        assert stored(site, "wet/time") == 0.0 and stored(site, "terrain/merge") == 1.0
        see(A, wet=1.0, terrain=STONE)
        with pytest.warns(RuntimeWarning, match="not go back"):
            site.merge(A, align=False, time=51.0)
        assert value(site, "wet") == 2.0 and counts(site) == [1.0, 1.0]
    with SiteMap.open(path, read_only=True) as site:
        assert value(site, "wet") == 2.0 and counts(site) == [1.0, 1.0]


@pytest.mark.slow(1)
def test_a_folder_without_these_layers_goes_on(tmp_path):
    """There, what is merged later counts as newer, and no cell counts as forgotten."""
    A, B, path = robot(), robot(), folder_without(tmp_path / "site")
    with SiteMap(resolution=0.1, path=path) as site:
        see(B, wet=2.0, terrain=GRASS)
        site.merge(B, align=False, time=100.0)
        see(A, times=3, wet=1.0, terrain=STONE)
        with pytest.warns(RuntimeWarning, match="not go back"):
            site.merge(A, align=False, time=51.0)
        see(A, terrain=STONE)
        site.merge(A, align=False, time=102.0)
        assert value(site, "wet") == 1.0 and counts(site) == [1.0, 4.0]
    assert [name for name in stored_layers(path) if name.endswith(("/time", "/merge"))] == []
