"""Channels of a site: what it keeps of the maps' channels, by kind, on disk and in files."""

import json
import re

import numpy as np
import pytest
import tifffile
import torch

from tests.helpers import pose, small_map
from torchelev import ChannelConfig
from torchelev.io.export import load_npz
from torchelev.site import SiteMap

CHANNELS = {
    "heat": "mean",
    "rgb": "color",
    "alarm": "maximum",
    "dino": ChannelConfig(kind="feature", size=2),
    "terrain": ChannelConfig(kind="class", names=("grass", "stone")),
    "wet": ChannelConfig(kind="exponential", rate=0.5),
    "door": ChannelConfig(kind="class_average", size=3),
}
SIZES = {"heat": 1, "rgb": 3, "alarm": 1, "dino": 2, "terrain": 2, "wet": 1, "door": 3}


def random_features(generator, shape):
    """Values of points for all channels."""
    values = {name: torch.rand(*shape, size, generator=generator) for name, size in SIZES.items()}
    for name in ("terrain", "door"):
        values[name] = values[name] / values[name].sum(-1, keepdim=True)
    return values


def look(emap, features, x=0.0, height=0.0, points=None):
    """Let each robot, at x along the way, see flat ground of a height; `features` are (B, N, C) by channel."""
    B = emap.num_envs
    T = pose((x, 0.0, 1.0), num_envs=B)
    points = torch.tensor([[[0.05, 0.05]]]).repeat(B, 1, 1) if points is None else points
    cloud = torch.cat([points, torch.full_like(points[..., :1], height - 1.0)], -1)
    emap.update(cloud, T, T, dt=0.1, features=features)


def value(site, layer, xy=(0.05, 0.05)):
    values, valid = site.sample(torch.tensor([xy]), layer, mode="nearest")
    return float(values[0]) if valid[0] else None


def test_a_single_robot_gives_its_own_channels():
    """Whatever it does, what the site says below its window is what its map says."""
    emap, site = small_map(cells=(12, 10), channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    generator = torch.Generator().manual_seed(0)
    for step in range(8):
        points = torch.rand(1, 60, 2, generator=generator) * torch.tensor([1.2, 1.0]) - torch.tensor([0.6, 0.5])
        look(emap, random_features(generator, (1, 60)), x=0.1 * step, points=points)
        if step % 2:
            site.merge(emap, align=False)
            x, y, _ = emap.center[0].tolist()
            area = site.window((x, y), 1.2, 1.0)
            for layer in (part for name in CHANNELS for part in emap.cfg.channels[name].components(name)):
                known = np.isfinite(emap.layer("elevation")[0].numpy())
                expected = np.where(known, emap.layer(layer)[0].numpy(), np.nan)
                found = np.where(known, area.layers[layer], np.nan)
                np.testing.assert_allclose(found, expected, atol=2e-5, err_msg=f"{layer} at step {step}")
    assert np.isfinite(site.window((0.0, 0.0), 4.0, 2.0).layers["heat"]).sum() > known.sum(), "it keeps what was left"


def test_evidence_of_several_robots_adds_up_and_counts_once():
    emap, site = small_map(num_envs=2, channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    both = torch.tensor([[[1.0]], [[4.0]]])
    stone = torch.tensor([[[1.0, 0.0]], [[0.0, 1.0]]])
    once = torch.tensor([[[1.0]], [[float("nan")]]])
    look(emap, {"heat": both, "terrain": stone, "alarm": both})
    look(emap, {"heat": once, "terrain": torch.tensor([[[1.0, 0.0]], [[float("nan")] * 2]])})
    for _ in range(3):  # nothing new: no evidence is added
        site.merge(emap, align=False)
        assert value(site, "heat") == pytest.approx((2 * 1.0 + 1 * 4.0) / 3, abs=1e-5)
        assert value(site, "terrain.grass") == pytest.approx((2 + 0.5) / (3 + 1), abs=1e-6)
        assert value(site, "alarm") == 4.0
    look(emap, {"heat": torch.tensor([[[float("nan")]], [[4.0]]])})
    site.merge(emap, align=False)
    assert value(site, "heat") == pytest.approx((2 * 1.0 + 2 * 4.0) / 4, abs=1e-5)
    assert value(site, "terrain.grass") == pytest.approx((2 + 0.5) / (3 + 1), abs=1e-6)


def test_what_was_measured_last_replaces_averages():
    emap, site = small_map(num_envs=2, channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    look(emap, {"wet": torch.tensor([[[1.0]], [[3.0]]])})
    nowhere = torch.tensor([[[0.05, 0.05]], [[float("nan")] * 2]])
    look(emap, {"wet": torch.tensor([[[2.0]], [[0.0]]])}, points=nowhere)  # the first robot alone
    site.merge(emap, align=False)
    assert value(site, "wet") == pytest.approx(1.5)  # 0.5 * 1 + 0.5 * 2
    look(emap, {"wet": torch.tensor([[[0.0]], [[5.0]]])}, points=nowhere.flip(0))
    site.merge(emap, align=False)
    assert value(site, "wet") == pytest.approx(4.0)  # 0.5 * 3 + 0.5 * 5


def test_what_another_robot_measured_later_stays():
    first, second = small_map(channels=CHANNELS), small_map(channels=CHANNELS)
    site = SiteMap(resolution=0.1, channels=CHANNELS)
    look(first, {"wet": torch.full((1, 1, 1), 1.0)})
    site.merge(first, align=False, time=1.0)
    look(second, {"wet": torch.full((1, 1, 1), 2.0)})
    site.merge(second, align=False, time=2.0)
    look(first, None)  # heights alone
    site.merge(first, align=False, time=3.0)
    assert value(site, "wet") == 2.0


def test_a_robot_that_comes_back_brings_new_evidence():
    emap, site = small_map(channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    everywhere = torch.cartesian_prod(torch.arange(-0.55, 0.6, 0.1), torch.arange(-0.45, 0.5, 0.1))[None]
    for x, heat in ((0.0, 1.0), (5.0, 7.0), (0.0, 4.0)):
        look(emap, {"heat": torch.full((1, everywhere.shape[1], 1), heat)}, x=x, points=everywhere)
        site.merge(emap, align=False)
    assert value(site, "heat") == pytest.approx(2.5, abs=1e-4)
    assert value(site, "heat", (5.05, 0.05)) == pytest.approx(7.0, abs=1e-4)


def test_what_contradicts_the_elevation_is_left_out():
    emap, site = small_map(num_envs=2, channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    nan = float("nan")
    for _ in range(20):
        look(emap, {"heat": torch.ones(2, 1, 1)}, points=torch.tensor([[[0.05, 0.05]], [[nan, nan]]]))
    higher = torch.tensor([[[nan, nan]], [[0.05, 0.05]]])
    look(emap, {"heat": torch.full((2, 1, 1), 9.0)}, height=0.3, points=higher)
    site.merge(emap, align=False)
    assert value(site, "elevation") == pytest.approx(0.0, abs=0.01) and value(site, "other_elevation") > 0.2
    assert value(site, "heat") == pytest.approx(1.0, abs=1e-5)


def test_an_obstacle_brings_its_own_and_a_robot_without_the_channel_forgets():
    emap, site = small_map(channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    look(emap, {"heat": torch.ones(1, 1, 1)})
    site.merge(emap, align=False)
    for _ in range(30):
        look(emap, {"heat": 9 * torch.ones(1, 1, 1)}, height=0.4)
        site.merge(emap, align=False)
    assert value(site, "elevation") == pytest.approx(0.4, abs=0.01) and value(site, "heat") == pytest.approx(
        9.0, abs=1e-4
    )
    plain = small_map()
    for _ in range(30):
        look(plain, None, height=0.0)
        site.merge(plain, align=False)
    assert value(site, "elevation") == pytest.approx(0.0, abs=0.01) and value(site, "heat") is None


def test_after_a_reset_a_robot_brings_new_evidence():
    """The first robot is reset and counts once more; what the second one knows stays its own."""
    emap, site = small_map(num_envs=2, channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    for number in (1.0, 4.0):
        look(emap, {"heat": torch.full((2, 1, 1), number)})
        site.merge(emap, align=False)
        emap.reset(torch.tensor([0]))
    assert value(site, "heat") == pytest.approx(2.5, abs=1e-5)  # two of each
    look(emap, {"heat": torch.full((2, 1, 1), 5.0)})
    site.merge(emap, align=False)
    assert value(site, "heat") == pytest.approx((1 + 4 + 5 + 1 + 4 + 5) / 6, abs=1e-5)


def test_images_count_without_new_points():
    emap, site = small_map(channels={"heat": "mean"}), SiteMap(resolution=0.1, channels={"heat": "mean"})
    look(emap, None)
    site.merge(emap, align=False)
    assert value(site, "heat") is None
    T = torch.eye(4)[None]  # looks down
    T[0, :3] = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]])
    K = torch.tensor([[10.0, 0.0, 9.5], [0.0, 10.0, 9.5], [0.0, 0.0, 1.0]])
    emap.paint(torch.full((1, 1, 20, 20), 7.0), K, T, "heat")
    site.merge(emap, align=False)
    assert value(site, "heat") == pytest.approx(7.0)


@pytest.mark.slow(1)
def test_on_disk_they_go_on(tmp_path):
    emap, path = small_map(channels=CHANNELS), tmp_path / "site"
    rgb = torch.tensor([[[1.0, 0.5, 0.0]]])
    with SiteMap(resolution=0.1, path=path, channels=CHANNELS) as site:
        look(emap, {"rgb": rgb, "heat": torch.ones(1, 1, 1)})
        site.merge(emap, align=False)
    with SiteMap(resolution=0.1, path=path) as site:  # the same robot, in the same process
        look(emap, {"heat": 4 * torch.ones(1, 1, 1)})
        site.merge(emap, align=False)
    with SiteMap.open(path, read_only=True) as site:
        assert [value(site, f"rgb.{part}") for part in ("red", "green", "blue")] == [1.0, 0.5, 0.0]
        assert value(site, "heat") == pytest.approx(2.5, abs=1e-5)
        assert site.window((0.0, 0.0), 1.0, 1.0, ["rgb"]).layers.keys() == {"rgb.red", "rgb.green", "rgb.blue"}
    with pytest.raises(
        ValueError, match="channels: must be kept from the first merge on, got heat; leave them out: the"
    ):
        SiteMap(resolution=0.1, path=path, channels={"heat": "mean"})
    SiteMap.open(path).close()  # it is not locked


@pytest.mark.slow(1)
def test_a_site_of_before_channels_opens(tmp_path):
    emap, path = small_map(channels=CHANNELS), tmp_path / "site"
    with SiteMap(resolution=0.1, path=path, engine="files") as site:
        look(emap, {"heat": torch.ones(1, 1, 1)})
        site.merge(emap, align=False)
    header = json.loads((path / "zarr.json").read_text())
    del header["attributes"]["channels"]
    (path / "zarr.json").write_text(json.dumps(header))
    with SiteMap.open(path) as site:
        assert value(site, "elevation") == pytest.approx(0.0, abs=1e-3)
        site.merge(emap, align=False)
        with pytest.raises(KeyError, match="layer: must be one of elevation, .*validity, got 'heat'"):
            site.sample(torch.zeros(1, 2), "heat")
    with pytest.raises(ValueError, match="leave them out: the site has none"):
        SiteMap(resolution=0.1, path=path, channels={"heat": "mean"})


def test_what_does_not_fit_is_refused():
    site = SiteMap(resolution=0.1, channels={"heat": "mean", "rgb": "color"})
    with pytest.raises(
        ValueError, match=re.escape("emap.cfg.channels['heat']: must be of kind mean with heat, as of the")
    ):
        site.merge(small_map(channels={"heat": "maximum"}))
    assert len(site) == 0
    with pytest.raises(ValueError, match="channels, keyframes and group: exclude each other"):
        SiteMap(resolution=0.1, channels={"heat": "mean"}, keyframes=True)
    with pytest.raises(ValueError, match="must have names that are words, and no layers of the map, got 'time'"):
        SiteMap(resolution=0.1, channels={"time": "mean"})


def test_files(tmp_path):
    emap, site = small_map(channels=CHANNELS), SiteMap(resolution=0.1, channels=CHANNELS)
    look(emap, {"rgb": torch.tensor([[[1.0, 0.5, 0.0]]])})
    site.merge(emap, align=False)
    site.export(tmp_path / "site.tif", layers=["elevation", "rgb"])
    with tifffile.TiffFile(tmp_path / "site.tif") as tiff:
        description = tiff.pages[0].tags[42112].value
        np.testing.assert_allclose(tiff.asarray()[:, 0, 0], [0.0, 1.0, 0.5, 0.0], atol=1e-6)
    roles = re.findall(r'name="COLORINTERP" sample="(\d)" role="colorinterp">(\w+)<', description)
    assert roles[-3:] == [("1", "Red"), ("2", "Green"), ("3", "Blue")]  # GDAL says that the first one is gray
    site.export(tmp_path / "site.npz", layers=["elevation", "rgb"])
    saved = load_npz(tmp_path / "site.npz")
    assert saved.layers["rgb.green"].max() == 0.5 and saved.config["channels"]["rgb"]["kind"] == "color"
