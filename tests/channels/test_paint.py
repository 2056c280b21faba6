"""Images on the ground: the right pixel, what the map hides, lenses, and gradients."""

import copy

import cv2
import numpy as np
import pytest
import torch

from torchelev import ElevationMap, ElevationMapConfig, FilterConfig, GridConfig
from torchelev.channels import camera, paint, painted_map
from torchelev.channels.config import KINDS, ChannelConfig
from torchelev.frames import change_axes
from torchelev.sim import mount

GRID = GridConfig(resolution=0.1, length_x=6.0, length_y=5.0)
H, W = 60, 80
K = torch.tensor([[70.0, 0.0, 38.0], [0.0, 72.0, 31.0], [0.0, 0.0, 1.0]])
LENS = (-0.28, 0.07, 1e-3, -5e-4, 0.01)


def make(num_envs=1, wall=0.0, **channels):
    """Maps of flat ground, with a wall of this height 1.5 m ahead."""
    emap = ElevationMap(ElevationMapConfig(grid=GRID, channels=channels), num_envs=num_envs)
    x, y = (torch.arange(n) * 0.05 - n * 0.025 + 0.025 for n in (120, 100))
    xy = torch.cartesian_prod(x, y)
    z = wall * ((xy[:, 0] - 1.5).abs() < 0.15) * (xy[:, 1].abs() < 1.0)
    points = torch.cat([xy, z[:, None] - 3.0], -1)[None].repeat(num_envs, 1, 1)
    T = torch.eye(4, dtype=torch.float64).repeat(num_envs, 1, 1)
    T[:, 2, 3] = 3.0
    emap.update(points, T, T, dt=0.1)
    return emap


def look(z=1.2, pitch=30.0, yaw=0.0, x=-0.4):
    """T_map_camera (1, 4, 4) in optical axes."""
    return change_axes(mount(pitch_deg=pitch, x=x, z=z, yaw_deg=yaw)[None], "forward", "optical")


def ramp(num_envs=1):
    """An image whose two values are the pixel's u and v."""
    v, u = torch.meshgrid(torch.arange(float(H)), torch.arange(float(W)), indexing="ij")
    return torch.stack([u, v])[None].repeat(num_envs, 1, 1, 1)


def test_a_cell_takes_the_pixel_that_shows_its_centre():
    emap, T = make(uv=ChannelConfig(kind="feature", size=2, normalize=False)), look()
    number = emap.paint(ramp(), K, T, "uv")
    uv = emap.layer("uv")[0]
    known = uv[0].isfinite()
    assert number.tolist() == [int(known.sum())]
    assert 200 < known.sum() < known.numel() / 2
    centers = torch.cat([emap.cell_centers()[0], torch.zeros(60, 50, 1)], -1)[known].double()
    in_camera = (centers - T[0, :3, 3].double()) @ T[0, :3, :3].double()
    expected = in_camera[:, :2] / in_camera[:, 2:] * torch.tensor([70.0, 72.0]) + torch.tensor([38.0, 31.0])
    inside = (expected > 0).all(-1) & (expected < torch.tensor([W - 1.0, H - 1.0])).all(-1)
    assert inside.sum() > 200
    torch.testing.assert_close(uv[:, known].T[inside].double(), expected[inside], atol=2e-3, rtol=0)


def test_the_nearest_pixel_is_read_as_it_is():
    emap = make(label=ChannelConfig())
    image = (torch.arange(H * W) % 7).view(1, 1, H, W).float()
    emap.paint(image, K, look(), "label", mode="nearest")
    values = emap.layer("label")
    assert set(values[values.isfinite()].tolist()) == set(range(7))


def test_the_map_hides_what_is_behind_a_wall():
    emap, open_ground = make(wall=0.6, grass=ChannelConfig()), make(grass=ChannelConfig())
    for one in (emap, open_ground):
        one.paint(torch.ones(1, 1, H, W), K, look(), "grass")
    seen, all_seen = (one.layer("grass")[0].isfinite() for one in (emap, open_ground))
    x = emap.cell_centers()[0, :, 0, 0]
    ahead = emap.cell_centers()[0, 0, :, 1].abs() < 0.5
    behind, before, top = ((x > low) & (x < high) for low, high in ((1.75, 2.1), (0.7, 1.2), (1.45, 1.55)))
    assert all_seen[behind][:, ahead].all() and not seen[behind][:, ahead].any()
    assert seen[before][:, ahead].all() and seen[top][:, ahead].all()
    emap.paint(torch.ones(1, 1, H, W), K, look(), "grass", margin=5.0)
    assert emap.layer("grass")[0].isfinite()[behind][:, ahead].all()


def test_lenses_are_opencv_s():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.6, 0.6, (200, 2)), np.ones((200, 1))], 1)
    for D in (LENS[:4], LENS, (0.3, -0.1, 1e-3, 1e-3, 0.02, 0.25, -0.05, 0.01)):
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(D))[0][:, 0]
        x, y, fits = camera.distort(*torch.from_numpy(points[:, :2].T.copy()), torch.tensor(D, dtype=torch.float64))
        assert fits.all()
        np.testing.assert_allclose(torch.stack([x, y], -1).numpy(), expected, atol=1e-9)


def test_a_lens_shows_nothing_beyond_where_its_model_folds_back():
    """With k1 = -0.28 alone, r f(r) falls from r = 1.09 on: a point at r = 1.9 would land at r = 0."""
    D = torch.tensor([-0.28, 0.0, 0.0, 0.0])
    r = torch.tensor([0.5, 1.05, 1.15, 1.89])
    x, _, fits = camera.distort(r, torch.zeros(4), D)
    assert fits.tolist() == [True, True, False, False] and x[3].abs() < 0.01


@pytest.mark.slow(2)
@pytest.mark.parametrize("distortion", [None, LENS, torch.tensor([[LENS, LENS], [[0.0] * 5, LENS]])])
def test_cpp_sees_what_tensors_define(distortion, monkeypatch):
    emap = make(num_envs=2, wall=0.5, grass=ChannelConfig())
    T = torch.stack([torch.cat([look(), look(yaw=70.0, pitch=20.0)])] * 2)
    T[1, :, 2, 3] += 0.5
    picture = paint.Picture(torch.zeros(2, 2, 1, H, W), K, T, "grass", distortion, emap.cfg.channels, 2, emap.device)
    fast = paint.look(picture, emap.state, GRID, 0.1)
    monkeypatch.setattr(paint, "can_look", lambda state: False)
    slow = paint.look(picture, emap.state, GRID, 0.1)
    assert 0.05 < slow.seen.float().mean() < 0.6
    assert (fast.seen != slow.seen).float().mean() < 1e-3  # a line may pass a corner on either side
    both = fast.seen & slow.seen
    torch.testing.assert_close(fast.uv[both], slow.uv[both], atol=1e-3, rtol=0)


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("kind", KINDS)
def test_cpp_paints_what_tensors_define(kind, mode, monkeypatch):
    cfg = ChannelConfig(kind=kind, size={"color": 3, "maximum": 1, "mean": 1}.get(kind, 2), max_age=9.0)
    image = torch.rand(2, 2, cfg.size, H, W, generator=torch.Generator().manual_seed(0))
    image = image.softmax(2) if kind.startswith("class") else image
    image[:, :, :, 20:24] = torch.nan
    T = torch.stack([torch.cat([look(), look(yaw=30.0)])] * 2)
    fast, slow = make(num_envs=2, wall=0.5, a=cfg), make(num_envs=2, wall=0.5, a=cfg)
    for _ in range(2):
        fast.paint(image, K, T, "a", mode=mode)
    monkeypatch.setattr(painted_map, "can_paint", lambda channel: False)
    for _ in range(2):
        slow.paint(image, K, T, "a", mode=mode)
    assert (slow.channels.a_weight > 0).float().mean() > 0.1
    for a, b in zip(fast.channels.channel("a"), slow.channels.channel("a"), strict=True):
        torch.testing.assert_close(a, b, atol=2e-4, rtol=0)


def test_an_image_of_several_channels():
    emap = make(rgb="color", grass=ChannelConfig())
    emap.paint(torch.rand(1, 4, H, W), K, look(), ("rgb", "grass"))
    assert emap.layer("rgb.blue").isfinite().sum() == emap.layer("grass").isfinite().sum() > 200
    image = torch.full((1, 3, H, W), 51, dtype=torch.uint8)
    emap.paint(image, K, look(), "rgb")
    assert emap.layer("rgb.red").isfinite().any()


def test_a_network_is_trained_through_the_map():
    """The image is 1 where a logit is high; the map says what each cell should be."""
    emap = make(grass=ChannelConfig())
    logit = torch.zeros(1, 1, H, W, requires_grad=True)
    optimizer = torch.optim.SGD([logit], lr=200.0)
    target = (emap.cell_centers()[..., 1] > 0).float()
    losses = []
    for _ in range(60):
        values, known = emap.painted(torch.sigmoid(logit), K, look(), "grass")
        loss = torch.nn.functional.binary_cross_entropy(values[:, 0][known], target[known])
        optimizer.zero_grad(), loss.backward(), optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0] and known.sum() > 200
    assert not emap.channels.grass_weight.any(), "`painted` changes nothing"


def test_painted_is_what_paint_does():
    emap, image = make(wall=0.4, rgb="color"), torch.rand(1, 3, H, W)
    emap.paint(torch.rand(1, 3, H, W), K, look(yaw=20.0), "rgb")
    values, known = emap.painted(image, K, look(), "rgb")
    emap.paint(image, K, look(), "rgb")
    after = emap.layer("rgb")
    assert torch.equal(known, after[:, 0].isfinite())
    torch.testing.assert_close(values[:, :, known[0]], after[:, :, known[0]], atol=1e-5, rtol=0)


def test_filters_of_a_channel_are_computed_anew():
    double = FilterConfig(layer="double", filter="expression", settings={"formula": "2 * grass"})
    cfg = ElevationMapConfig(grid=GRID, channels={"grass": ChannelConfig(kind="maximum")}, filters=(double,))
    emap = ElevationMap(cfg)
    emap.load_state(make().state)
    for value in (1.0, 3.0):
        emap.paint(torch.full((1, 1, H, W), value), K, look(), "grass")
        assert emap.layer("double").nan_to_num().max().item() == pytest.approx(2 * value)


def test_a_camera_far_away_takes_no_time_and_sees_nothing():
    emap, T = make(grass=ChannelConfig()), look()
    T[:, 0, 3] = 1e8
    assert emap.paint(torch.ones(1, 1, H, W), K, T, "grass").tolist() == [0]
    assert emap.layer("grass").isnan().all()


@pytest.mark.parametrize(
    "change, error, words",
    [
        ({"channels": "dino"}, KeyError, "channels: must name channels of the map: rgb, terrain, got 'dino'"),
        (
            {"image": torch.zeros(1, 2, H, W)},
            ValueError,
            r"image: expected \(1, 3, h, w\) or \(1, V, 3, h, w\), got \(1, 2",
        ),
        (
            {"image": torch.full((1, 3, H, W), 2.0)},
            ValueError,
            "image of 'rgb': must be colours from 0 to 1, got 2, 2, 2",
        ),
        (
            {"channels": "terrain", "image": torch.ones(1, 2, H, W)},
            ValueError,
            "image of 'terrain': must be probabilities",
        ),
        ({"image": np.zeros((1, 3, H, W))}, TypeError, "image: must be a torch.Tensor"),
        (
            {"K": 10 * K},
            ValueError,
            "K: must have positive focal lengths and its centre in the middle of the image of 80 x 60",
        ),
        (
            {"K": K * torch.tensor([[0.5], [0.5], [1.0]])},
            ValueError,
            "K: must have positive focal lengths and its centre",
        ),
        ({"K": K[:2]}, ValueError, r"K: expected \(3, 3\), \(1, 3, 3\) or \(1, 1, 3, 3\), got \(2, 3\)"),
        ({"T_map_camera": torch.zeros(1, 4, 4)}, ValueError, "T_map_camera: must be rigid"),
        ({"distortion": (0.1, 0.2)}, ValueError, "distortion: must be 4, 5 or 8 coefficients"),
        ({"mode": "cubic"}, ValueError, "mode: must be one of bilinear, nearest, got 'cubic'"),
        ({"margin": 0.0}, ValueError, "margin: must be a positive number"),
    ],
)
def test_refuses_what_does_not_fit(change, error, words):
    emap = make(rgb="color", terrain=ChannelConfig(kind="class", size=2))
    given = {"image": torch.zeros(1, 3, H, W), "K": K, "T_map_camera": look(), "channels": "rgb"} | change
    before = copy.deepcopy(emap.channels.state_dict())
    with pytest.raises(error, match=words):
        emap.paint(**given)
    assert all(torch.equal(value.nan_to_num(-7), before[name].nan_to_num(-7))
               for name, value in emap.channels.state_dict().items())  # fmt: skip
