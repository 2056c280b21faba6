"""Channels of a site: of values that replace each other, the one that was measured last."""

import pytest
import torch

from tests.helpers import pose, small_map
from tests.site.channel_cases import (
    CHANNELS,
    GRASS,
    STONE,
    counts,
    folder_without,
    robot,
    see,
    stored,
    stored_layers,
    value,
)
from torchelev import ChannelConfig
from torchelev.site import SiteMap

NEWEST = [("wet", 2.0, 1.0), ("door", (0.0, 1.0), (1.0, 0.0))]  # channel, a value of B, another one of A


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
