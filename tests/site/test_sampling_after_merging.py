"""A site is read and merged to within inference mode and outside of it, also where tiles must come from disk."""

import torch

from tests.site.helpers import fill, ground, robots
from torchelev.site import SiteConfig, SiteMap


def test_tiles_that_left_memory_are_read_again(tmp_path):
    emap = robots([(0, 0)])
    with SiteMap(0.1, tmp_path / "site", cfg=SiteConfig(cache_tiles=2)) as site:
        for number in range(4):
            fill(emap, [(200 * number, 0)])
            emap.state.elapsed.add_(10**9)
            site.merge(emap)
        xy = torch.tensor([[20.0 * number + 1.0, 1.0] for number in range(4)])
        values, valid = site.sample(xy)
        assert valid.all() and not values.is_inference()
        torch.testing.assert_close(values, ground(*xy.T), atol=2e-3, rtol=0.0)


def test_a_site_that_was_read_in_inference_mode_can_be_merged_to(tmp_path):
    emap = robots([(0, 0)])
    with SiteMap(0.1, tmp_path / "site") as site:
        site.merge(emap)
    with torch.inference_mode():
        site = SiteMap(0.1, tmp_path / "site")
        assert site.sample(torch.tensor([[1.0, 1.0]]))[1].all()
    emap.state.elapsed.add_(10**9)
    site.merge(emap)
    assert site.sample(torch.tensor([[1.0, 1.0]]))[1].all()
    site.close()
