"""Channels in scans and images: what cells hold, where it is known, the shape, and what is refused."""

import copy
import dataclasses

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.helpers import pose
from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig, HeightScan, MapImage
from torchelev.observations.scan.presets import PRESETS

CHANNELS = {
    "rgb": "color",
    "heat": ChannelConfig(kind="maximum"),
    "terrain": ChannelConfig(kind="class", names=("grass", "stone")),
}
CFG = ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=3.2, length_y=3.2), channels=CHANNELS)
NAMES = ("terrain.stone", "rgb", "heat")
COMPONENTS = ("terrain.stone", "rgb.red", "rgb.green", "rgb.blue", "heat")
FEET = torch.tensor([[[0.3, 0.2, 0.1], [-0.3, 0.1, 0.0]], [[5.2, 0.1, 0.0], [5.1, -0.2, 0.0]]])
T_MAP_BASE = torch.cat([pose((0.03, -0.02, 0.6), yaw=0.7, pitch=0.1), pose((5.0, 0.0, 0.7), yaw=-2.0)])


@pytest.fixture(scope="module")
def emap():
    """Two maps of random values, with holes in the heights, and further ones in each channel."""
    emap = ElevationMap(CFG, num_envs=2)
    generator = torch.Generator().manual_seed(0)
    xy = 3.2 * torch.rand(2, 1500, 2, generator=generator) - 1.6
    heights = 0.2 * torch.rand(2, 1500, 1, generator=generator) - 0.7
    hole = (xy - 0.4).norm(dim=-1, keepdim=True) < 0.5
    points = torch.where(hole, torch.nan, torch.cat([xy, heights], -1))
    T = torch.cat([pose((0.03, -0.02, 0.6)), pose((5.0, 0.0, 0.7))])
    stone = torch.rand(2, 1500, 1, generator=generator)
    features = {
        "rgb": torch.rand(2, 1500, 3, generator=generator),
        "heat": torch.where(xy[..., 0] > 0.5, torch.nan, 30 * xy[..., 1]),
        "terrain": torch.cat([1 - stone, stone], -1),
    }
    emap.update(points, T, T, dt=0.1, features=features)
    return emap


def expected_rows(emap, xy, fill, names=COMPONENTS):
    read = [emap.sample(xy, name, "nearest") for name in names]
    values = torch.stack([torch.where(valid, value, fill) for value, valid in read], 1)
    return values, torch.stack([valid for _, valid in read], 1)


@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize("name", [*PRESETS, "grid", "feet"])
def test_a_scan_reads_heights_then_the_cells_of_channels(emap, name, native, monkeypatch):
    monkeypatch.setenv("TORCHELEV_NATIVE", native)
    make = getattr(HeightScan, name)
    settings = {"num_feet": 2, "reach": 0.4, "clip": 1.0} if name == "feet" else {"clip": 1.0}
    feet = (FEET,) if name == "feet" else ()
    scan = make(channels=NAMES, channel_fill=-2.0, **settings)
    values, valid = scan(emap, T_MAP_BASE, *feet)
    assert values.dtype == torch.float32 and values.shape == valid.shape == (2, 6, scan.num_points)
    assert scan.shape_on(CFG) == (6, scan.num_points)
    with pytest.raises(TypeError, match="cfg: must be an ElevationMapConfig, got ElevationMap; give emap.cfg"):
        scan.shape_on(emap)
    heights, known = make(**settings)(emap, T_MAP_BASE, *feet)
    assert torch.equal(values[:, 0], heights) and torch.equal(valid[:, 0], known)
    rows, rows_known = expected_rows(emap, scan.xy(T_MAP_BASE, *feet), -2.0)
    assert torch.equal(values[:, 1:], rows) and torch.equal(valid[:, 1:], rows_known)
    assert (~known).any() and (known & ~valid[:, 5]).any() and valid[:, 5].any()  # the heat is known where it was seen


def test_an_image_has_channels_after_its_layers(emap):
    image = MapImage(length_x=2.0, length_y=1.6, resolution=0.1, channels=NAMES, channel_fill=0.5)
    pixels = image(emap, T_MAP_BASE)
    assert pixels.shape == (2, *image.shape_on(CFG)) == (2, 9, 20, 16)
    plain = dataclasses.replace(image, channels=())
    assert torch.equal(pixels[:, :4], plain(emap, T_MAP_BASE)) and plain.shape == plain.shape_on(CFG) == (4, 20, 16)
    rows, known = expected_rows(emap, image.xy(T_MAP_BASE), 0.5)
    assert torch.equal(pixels[:, 4:].flatten(2), rows) and not known.all()
    with pytest.raises(ValueError, match=r"shape: must be of an image without channels, got .*; use shape_on\(cfg\)"):
        image.shape  # noqa: B018


def test_names_expand_in_their_order_and_may_repeat(emap):
    scan = HeightScan.points([(0.0, 0.0), (-0.5, 0.2)], channels=["rgb.blue", "rgb"])
    values, _ = scan(emap, T_MAP_BASE)
    assert (
        values.shape == (2, 5, 2) and torch.equal(values[:, 1], values[:, 4]) and scan.channels == ("rgb.blue", "rgb")
    )
    assert HeightScan.points([(0.0, 0.0)]).shape_on(CFG) == (1,)


def test_another_state_keeps_the_channels_of_ground_that_is_the_same(emap):
    scan = HeightScan.grid(channels=("rgb",))
    state = emap.state._replace(elevation=emap.state.elevation + (torch.arange(2) * 0.5).view(2, 1, 1))
    _, valid = scan(emap, T_MAP_BASE, state=state)
    assert torch.equal(valid[0], scan(emap, T_MAP_BASE)[1][0]) and not valid[1, 1:].any() and valid[1, 0].any()


def test_points_outside_the_window_or_poses_that_are_not_finite_read_the_fill(emap):
    scan = HeightScan.points([(0.0, 0.0)], channels=("rgb",), channel_fill=7.0)
    far = T_MAP_BASE.clone()
    far[:, 0, 3] = 40.0
    values, valid = scan(emap, far)
    assert not valid.any() and (values[:, 1:] == 7.0).all()


def test_noise_clip_and_scale_are_those_of_heights(emap):
    scan = HeightScan.isaac_lab(channels=("heat",), scale=3.0)
    noisy = scan(emap, T_MAP_BASE, noise=torch.rand(2, 187))[0]
    plain = HeightScan.grid(length_x=1.6, channels=("heat",))(emap, T_MAP_BASE)[0]
    assert not torch.equal(noisy[:, 0], scan(emap, T_MAP_BASE)[0][:, 0])
    torch.testing.assert_close(noisy[:, 1].view(2, 11, 17).mT.flatten(1), plain[:, 1])
    assert noisy[:, 1].abs().max() > 10


def test_gradients_reach_the_heights_and_their_poses(emap):
    T = T_MAP_BASE.clone().requires_grad_()
    elevation = emap.state.elevation.clone().requires_grad_()
    scan = HeightScan.grid(channels=NAMES)
    got = torch.autograd.grad(scan(emap, T, state=emap.state._replace(elevation=elevation))[0].sum(), (T, elevation))
    plain = HeightScan.grid()(emap, T, state=emap.state._replace(elevation=elevation))[0]
    for value, expected in zip(got, torch.autograd.grad(plain.sum(), (T, elevation)), strict=True):
        torch.testing.assert_close(value, expected)
        assert value.any()


class Reading(torch.nn.Module):
    """What a policy would read, as a module that can be exported."""

    def __init__(self, emap):
        super().__init__()
        self.emap = emap
        self.scan = HeightScan.grid(channels=NAMES)
        self.image = MapImage(channels=("rgb", "terrain.grass"), length_x=0.8, length_y=0.8)

    def forward(self, T):
        return *self.scan(self.emap, T), self.image(self.emap, T)


@pytest.mark.slow(3)
def test_reading_compiles_and_exports_without_a_break(emap):
    reading = Reading(copy.deepcopy(emap))
    expected = reading(T_MAP_BASE)
    compiled = torch.compile(reading, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(T_MAP_BASE), expected)
    exported = torch.export.export(reading, (T_MAP_BASE,))
    torch.testing.assert_close(exported.module()(T_MAP_BASE), expected)


def test_reading_does_not_wait_for_the_device():
    with FakeTensorMode():
        maps, T = ElevationMap(CFG, num_envs=2), torch.zeros(2, 4, 4, dtype=torch.float64)
        assert HeightScan.grid(channels=NAMES)(maps, T)[0].shape == (2, 6, 187)
        assert MapImage(channels=NAMES)(maps, T).shape == (2, 9, 32, 32)


@pytest.mark.parametrize("make", [HeightScan.grid, MapImage], ids=["scan", "image"])
def test_bad_channels_are_refused(emap, make):
    for channels, words in [
        ("rgb", 'channels: must be a list of names, got \'rgb\'; give \\("rgb", "terrain.stone"\\)'),
        ((1,), "channels: must be a list of names"),
    ]:
        with pytest.raises(ValueError, match=words):
            make(channels=channels)
    with pytest.raises(ValueError, match="channel_fill: must be a finite number, got nan"):
        make(channels=("rgb",), channel_fill=float("nan"))
    for channel, words in [
        ("snow", "channels: must name channels of the map, got 'snow'; there are rgb, heat, terrain"),
        ("elevation", "channels: must name channels of the map, got 'elevation'"),
        ("terrain.mud", "channels: must be components of terrain, got 'terrain.mud'; there are terrain.grass, terrain"),
        ("heat.0", "channels: must be components of heat, got 'heat.0'; there are heat"),
    ]:
        reader = make(channels=("rgb", channel))
        for call in (lambda reader=reader: reader(emap, T_MAP_BASE), lambda reader=reader: reader.shape_on(CFG)):
            with pytest.raises(KeyError, match=words):
                call()
    with pytest.raises(KeyError, match="there are none: give the config channels"):
        make(channels=("rgb",))(ElevationMap(num_envs=2), T_MAP_BASE)


def test_a_channel_among_the_layers_of_an_image_is_refused_with_the_way_to_read_it():
    with pytest.raises(ValueError, match="layers: .*or give those of the map's channels as channels="):
        MapImage(layers=("elevation", "rgb.red"))
