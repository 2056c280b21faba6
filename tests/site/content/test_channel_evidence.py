"""Channels of a site: what of a robot's evidence is in there, and what is taken out again."""

import numpy as np
import pytest

from tests.helpers import small_map
from tests.site.channel_cases import CHANNELS, GRASS, STONE, counts, folder_without, robot, see, stored, value
from torchelev.site import SiteMap


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
