"""Channels: what points bring, how it is fused by kind, and how it follows the ground."""

import copy
import math

import pytest
import torch

from torchelev import BodyConfig, ElevationMap, ElevationMapConfig, GridConfig, SensorConfig
from torchelev.channels import module
from torchelev.channels.config import KINDS, ChannelConfig

GRID = GridConfig(resolution=0.1, length_x=3.2, length_y=2.4)
CELL = torch.tensor([[0.05, 0.05]])  # its centre [m]


def make(num_envs=1, **channels):
    return ElevationMap(ElevationMapConfig(grid=GRID, channels=channels), num_envs=num_envs)


def pose(x=0.0, z=1.0, num_envs=1):
    T = torch.eye(4, dtype=torch.float64).repeat(num_envs, 1, 1)
    T[:, 0, 3], T[:, 2, 3] = x, z
    return T


def see(emap, values, height=0.0, dt=0.1, x=0.0, **kwargs):
    """Update with points on the ground in the cell at (0.05, 0.05): one for each row of the values of each channel."""
    number = len(next(iter(values.values())))
    points = torch.tensor([[[0.05 - x, 0.05, height - 1.0]]]).repeat(1, number, 1)
    T = pose(x)
    emap.update(points, T, T, dt=dt, features={name: torch.tensor([rows]) for name, rows in values.items()}, **kwargs)


def at_cell(emap, layer):
    value, valid = emap.sample(CELL[None], layer, "nearest")
    return value.item() if valid.item() else math.nan


# Kinds ----------------------------------------------------------------------------------------------------------------


def test_a_mean_weighs_points_by_the_variance_of_their_heights():
    emap = make(grass=ChannelConfig())
    see(emap, {"grass": [1.0, 4.0]}, variance=torch.tensor([[1e-4, 2e-4]]))
    assert at_cell(emap, "grass") == pytest.approx((1.0 + 4.0 / 2) / 1.5)
    see(emap, {"grass": [7.0]}, variance=torch.tensor([[1e-4]]))
    assert at_cell(emap, "grass") == pytest.approx((1.0 + 4.0 / 2 + 7.0) / 2.5)


def test_an_exponential_mean_takes_its_share_of_each_update():
    emap = make(grass=ChannelConfig(kind="exponential", rate=0.25))
    see(emap, {"grass": [1.0, 3.0]})
    assert at_cell(emap, "grass") == pytest.approx(2.0)
    see(emap, {"grass": [6.0]})
    assert at_cell(emap, "grass") == pytest.approx(0.75 * 2.0 + 0.25 * 6.0)


def test_a_maximum_is_the_largest_ever():
    emap = make(heat=ChannelConfig(kind="maximum"))
    for values, expected in (([-3.0, -5.0], -3.0), ([-4.0], -3.0), ([2.0], 2.0)):
        see(emap, {"heat": values})
        assert at_cell(emap, "heat") == expected


def test_classes_by_bayes_are_dirichlet_counts():
    emap = make(terrain=ChannelConfig(kind="class", names=("grass", "stone", "mud"), prior=0.6))
    see(emap, {"terrain": [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0]]})
    see(emap, {"terrain": [[1.0, 0.0, 0.0]]})
    found = [at_cell(emap, f"terrain.{name}") for name in ("grass", "stone", "mud")]
    assert found == pytest.approx([(2.5 + 0.2) / 3.6, (0.5 + 0.2) / 3.6, 0.2 / 3.6])


def test_averaged_classes_follow_the_last_update():
    emap = make(terrain=ChannelConfig(kind="class_average", size=2, rate=0.5))
    see(emap, {"terrain": [[1.0, 0.0]]})
    see(emap, {"terrain": [[0.0, 1.0], [0.5, 0.5]]})
    assert at_cell(emap, "terrain.0") == pytest.approx(0.5 * 1.0 + 0.5 * 0.25)


def test_features_are_read_as_unit_vectors():
    for normalize, expected in ((True, (0.6, 0.8)), (False, (3.0, 4.0))):
        emap = make(dino=ChannelConfig(kind="feature", size=2, normalize=normalize))
        see(emap, {"dino": [[2.0, 5.0], [4.0, 3.0]]}, variance=torch.full((1, 2), 1e-4))
        assert (at_cell(emap, "dino.0"), at_cell(emap, "dino.1")) == pytest.approx(expected)


def test_colours_come_as_bytes_or_fractions():
    for rows in ([[255, 0, 51]], [[1.0, 0.0, 0.2]]):
        emap = make(rgb="color")
        points, T = torch.tensor([[[0.05, 0.05, -1.0]]]), pose()
        dtype = torch.uint8 if rows[0][0] == 255 else torch.float32
        emap.update(points, T, T, dt=0.1, features={"rgb": torch.tensor([rows], dtype=dtype)})
        assert [at_cell(emap, f"rgb.{c}") for c in ("red", "green", "blue")] == pytest.approx([1.0, 0.0, 0.2])


def test_half_precision_is_stored_as_such():
    emap = make(dino=ChannelConfig(kind="feature", size=3, dtype="float16", normalize=False))
    see(emap, {"dino": [[1.0, 2.0, 3.0]]})
    assert emap.channels.dino_values.dtype == torch.float16
    assert at_cell(emap, "dino.2") == pytest.approx(3.0, abs=2e-3)


# Time and ground ------------------------------------------------------------------------------------------------------


def test_evidence_halves_in_its_half_life():
    emap = make(grass=ChannelConfig(half_life=2.0))
    see(emap, {"grass": [1.0]}, variance=torch.tensor([[1e-4]]))
    see(emap, {"grass": [4.0]}, dt=2.0, variance=torch.tensor([[1e-4]]))
    assert at_cell(emap, "grass") == pytest.approx((0.5 * 1.0 + 4.0) / 1.5)


def test_a_cell_is_forgotten_at_its_largest_age():
    emap = make(grass=ChannelConfig(max_age=1.0), stone=ChannelConfig())
    see(emap, {"grass": [1.0], "stone": [2.0]})
    see(emap, {"stone": [2.0]}, dt=0.9)
    assert at_cell(emap, "grass") == 1.0
    see(emap, {"stone": [2.0]}, dt=0.2)
    assert math.isnan(at_cell(emap, "grass")) and at_cell(emap, "stone") == 2.0


def test_channels_move_with_the_window():
    emap = make(grass=ChannelConfig(), rgb="color")
    see(emap, {"grass": [3.0], "rgb": [[0.5, 0.25, 1.0]]})
    for x in (0.4, 1.2, -0.7):
        nothing = torch.full((1, 1, 3), torch.nan)
        emap.update(nothing, pose(x), pose(x), dt=0.1)
        assert at_cell(emap, "grass") == 3.0 and at_cell(emap, "rgb.green") == 0.25
    for x in (5.0, 0.0):
        emap.update(nothing, pose(x), pose(x), dt=0.1)
    assert math.isnan(at_cell(emap, "grass"))
    assert emap.layer("rgb").isnan().all()


def test_an_obstacle_brings_its_own():
    emap = make(grass=ChannelConfig())
    for _ in range(2):
        see(emap, {"grass": [1.0] * 10})
    for _ in range(12):
        see(emap, {"grass": [5.0] * 10}, height=0.3)
    assert emap.sample(CELL[None])[0].item() == pytest.approx(0.3, abs=0.01)
    assert at_cell(emap, "grass") == pytest.approx(5.0)


def test_points_above_the_ground_do_not_speak_for_it():
    emap = make(grass=ChannelConfig())
    for _ in range(3):
        see(emap, {"grass": [1.0] * 20})
    points = torch.tensor([[[0.05, 0.05, -1.0]] * 20 + [[0.05, 0.05, -0.6]]])
    values = torch.tensor([[1.0] * 20 + [100.0]])
    emap.update(points, pose(), pose(), dt=0.1, features={"grass": values})
    assert at_cell(emap, "grass") == pytest.approx(1.0)


def test_points_that_the_map_leaves_out_count_for_no_channel():
    body = BodyConfig(lower=(-0.2, -0.2, -1.2), upper=(0.2, 0.2, 0.2))
    sensor = SensorConfig(body=body, min_distance=0.3, max_distance=1.5)
    cfg = ElevationMapConfig(grid=GRID, sensor=sensor, channels={"grass": ChannelConfig(kind="maximum")})
    places = {"ground": (0.55, 0.05, -1.0), "foot": (0.05, 0.05, -1.0), "far": (1.35, 0.85, -1.0)}
    for name, where in places.items():
        emap = ElevationMap(cfg)
        others = torch.tensor([[0.35, -0.35, -1.0]])
        emap.state.elevation.zero_(), emap.state.validity.fill_(True)
        points = torch.cat([torch.tensor([where]), others])[None]
        emap.update(points, pose(), pose(), dt=0.1, features={"grass": torch.tensor([[7.0, torch.nan]])})
        assert bool((emap.layer("grass") == 7.0).any()) == (name == "ground"), name
    for variance in (0.0, -1.0, math.inf, math.nan):
        emap = make(grass=ChannelConfig(kind="maximum"))
        see(emap, {"grass": [1.0]})
        see(emap, {"grass": [9.0]}, variance=torch.tensor([[variance]]))
        assert at_cell(emap, "grass") == 1.0


def test_what_forgets_a_cell_forgets_its_channels():
    emap = make(grass=ChannelConfig())
    see(emap, {"grass": [1.0]})
    emap.clear_around(CELL, radius=0.2)
    see(emap, {"grass": [2.0]})
    assert at_cell(emap, "grass") == 2.0, "and not the mean with what was there before"
    emap.clear_around(CELL, radius=0.2)
    assert math.isnan(at_cell(emap, "grass"))


def test_a_reset_forgets_the_channels_of_its_environments():
    emap = make(num_envs=3, grass=ChannelConfig())
    points = torch.tensor([[[0.05, 0.05, -1.0]]]).repeat(3, 1, 1)
    T = pose(num_envs=3)
    emap.update(points, T, T, dt=0.1, features={"grass": torch.tensor([[1.0], [2.0], [3.0]])})
    emap.reset(torch.tensor([1]))
    assert emap.layer("grass").nan_to_num().amax((1, 2)).tolist() == [1.0, 0.0, 3.0]
    emap.reset(mask=torch.tensor([True, False, False]))
    assert emap.layer("grass").nan_to_num().amax((1, 2)).tolist() == [0.0, 0.0, 3.0]
    emap.reset()
    assert emap.layer("grass").isnan().all() and not emap.channels.grass_weight.any()


def test_drift_compensation_keeps_channels():
    emap = make(grass=ChannelConfig(tolerance=0.02))
    axis = torch.arange(-0.95, 1.0, 0.1)
    points = torch.cartesian_prod(axis, axis, torch.tensor([-1.0]))[None].repeat(1, 4, 1)
    for k in range(8):
        emap.update(points, pose(z=1.0 + 0.01 * k), pose(), dt=0.1, features={"grass": torch.ones(points.shape[:2])})
    assert float(emap.statistics.drift_correction.abs()) > 0.003
    assert int((emap.layer("grass") == 1.0).sum()) == 400


# The two backends -----------------------------------------------------------------------------------------------------


def every_kind():
    sizes = {"color": 3, "class": 4, "class_average": 4, "feature": 5}
    ages = {"mean": {"half_life": 2.0}, "class": {"half_life": 1.0}, "maximum": {"max_age": 1.0}}
    return {f"of_{kind}": ChannelConfig(kind=kind, size=sizes.get(kind, 1), **ages.get(kind, {})) for kind in KINDS}


@pytest.mark.slow(2)
def test_cpp_computes_what_tensors_define(monkeypatch):
    """Points of two sensors, some of which are not finite, over windows that move and ground that changes."""
    body = BodyConfig(lower=(-0.5, -0.3, -2.0), upper=(0.4, 0.3, 0.5))
    cfg = ElevationMapConfig(grid=GRID, sensor=SensorConfig(body=body), channels=every_kind())
    maps = [ElevationMap(cfg, num_envs=3) for _ in range(2)]
    generator = torch.Generator().manual_seed(0)
    can_update = module.can_update
    assert can_update({"a": maps[0].channels.channel("of_mean")}, maps[0].state, maps[0].cfg.sensor), (
        "without C++, this compares nothing"
    )
    for frame in range(8):
        points = 1.5 * torch.randn(3, 2, 1500, 3, generator=generator)
        points[..., 2] = (
            -0.5 + 0.03 * torch.randn(3, 2, 1500, generator=generator) + 0.3 * (points[..., 0] > 1) * (frame > 4)
        )
        points[:, :, ::7] = torch.nan
        T = torch.eye(4, dtype=torch.float64).repeat(3, 2, 1, 1)
        T[..., 2, 3], T[..., 0, 3] = 0.5, 0.13 * frame * torch.tensor([[1.0], [0.0], [-2.0]])
        features = {}
        for name, cfg in maps[0].cfg.channels.items():
            x = torch.rand(3, 2, 1500, cfg.size, generator=generator)
            x = x.softmax(-1) if cfg.kind.startswith("class") else x
            x[:, :, ::5] = torch.nan
            features[name] = x
        for emap, choose in zip(maps, (can_update, lambda *args: False), strict=True):
            monkeypatch.setattr(module, "can_update", choose)
            emap.update(points, T, T[:, 0], dt=0.3, features={} if frame == 6 else features)
    for name in maps[0].cfg.channels:
        fast, slow = (emap.channels.channel(name) for emap in maps)
        assert 0.3 < (slow.weight > 0).float().mean() < 0.95
        for a, b in zip(fast, slow, strict=True):
            if a is not None:
                torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("in_cpp", [True, False])
def test_points_above_the_ramp_and_without_a_sound_variance_count_for_no_channel(in_cpp, monkeypatch):
    if not in_cpp:
        monkeypatch.setattr(module, "can_update", lambda *args: False)
    emap = make(grass=ChannelConfig(tolerance=1e6), mean=ChannelConfig(tolerance=1e6))
    points = torch.tensor([[[0.05, 0.05, -1.0], [0.05, 0.05, 0.5], [0.05, 0.05, -1.0]]])
    variance = torch.tensor([[1e-4, 1e-4, 1e-39]])  # of which the last has no finite inverse
    values = torch.tensor([[1.0, 5.0, 7.0]])
    given = {"grass": values, "mean": values}
    emap.update(points, pose(), pose(), dt=0.1, variance=variance, features=given)
    assert at_cell(emap, "grass") == at_cell(emap, "mean") == pytest.approx(1.0)


def test_a_channel_of_red_green_and_blue_is_a_colour_unless_these_are_classes():
    names = ("red", "green", "blue")
    assert ChannelConfig(kind="exponential", names=names).is_color and ChannelConfig(kind="color").is_color
    assert not ChannelConfig(kind="class", names=names).is_color and not ChannelConfig(kind="feature", size=3).is_color


def test_features_have_gradients_by_the_definition():
    from torchelev.channels.fuse import GroundPoints, accumulate, combine, read
    from torchelev.channels.state import blank_channel

    for kind in KINDS:
        cfg = ChannelConfig(kind=kind, size=3 if kind == "color" else 2)
        x = torch.rand(1, 4, cfg.size, dtype=torch.float64, requires_grad=True)
        ones = torch.ones(1, 4, dtype=torch.float64)
        points = GroundPoints(torch.tensor([[0, 0, 1, 3]]), ones > 0, 0 * ones, 1e-4 * ones)
        added, total = accumulate(x, points, 4, cfg)
        blank = blank_channel(cfg, (1, 2, 2), "cpu")
        new = combine(blank, added.view(1, 2, 2, -1), total.view(1, 2, 2), cfg)
        read(new, cfg)[0][0, 0].sum().backward()
        assert (x.grad[0, :3].abs().sum(-1) > 0).any() or kind in ("class", "feature")
        assert not x.grad[0, 3].any()


# Reading, keeping, refusing -------------------------------------------------------------------------------------------


def test_layers_of_channels():
    emap = make(rgb="color", grass=ChannelConfig(), terrain=ChannelConfig(kind="class", names=("mud", "stone")))
    own = ("rgb.red", "rgb.green", "rgb.blue", "grass", "terrain.mud", "terrain.stone")
    assert emap.layers[-6:] == own
    see(emap, {"rgb": [[0.1, 0.2, 0.3]], "grass": [1.0], "terrain": [[0.0, 1.0]]})
    assert emap.layer("rgb").shape == (1, 3, 32, 24) and emap.layer("grass").shape == (1, 32, 24)
    for k, name in enumerate(own[:3]):
        torch.testing.assert_close(emap.layer("rgb")[:, k], emap.layer(name), equal_nan=True)
    assert emap.layer("rgb").isfinite().sum() == 3
    with pytest.raises(KeyError, match="layer: must be a layer's name, got 'rgb.alpha'"):
        emap.layer("rgb.alpha")


def test_channels_are_saved_and_copied_with_the_map():
    emap = make(rgb="color", grass=ChannelConfig(max_age=5.0))
    see(emap, {"rgb": [[0.1, 0.2, 0.3]], "grass": [2.0]})
    other = make(rgb="color", grass=ChannelConfig(max_age=5.0))
    other.load_state_dict(emap.state_dict())
    for again in (other, copy.deepcopy(emap)):
        assert at_cell(again, "grass") == 2.0 and at_cell(again, "rgb.blue") == pytest.approx(0.3)
    with pytest.raises(ValueError, match="state_dict: must be of the same config, got other channels"):
        make(rgb="color").load_state_dict(emap.state_dict())
    assert ElevationMapConfig.from_dict(emap.cfg.to_dict()) == emap.cfg
    assert "channels" not in ElevationMapConfig().to_dict()


def test_checkpoints_load_as_weights_alone(tmp_path):
    emap = make(rgb="color", terrain=ChannelConfig(kind="class", names=("mud", "stone")))
    see(emap, {"rgb": [[0.1, 0.2, 0.3]], "terrain": [[1.0, 0.0]]})
    torch.save(emap.state_dict(), tmp_path / "map.pt")
    again = ElevationMap(emap.cfg)
    again.load_state_dict(torch.load(tmp_path / "map.pt"))
    assert at_cell(again, "rgb.green") == pytest.approx(0.2)


def test_maps_made_in_inference_mode_are_reset_outside_of_it():
    with torch.inference_mode():
        emap = make(grass=ChannelConfig())
        see(emap, {"grass": [1.0]})
    emap.reset(torch.tensor([0]))
    assert math.isnan(at_cell(emap, "grass"))


def test_channels_of_another_state_lie_where_its_ground_does():
    emap = make(grass=ChannelConfig())
    see(emap, {"grass": [3.0]})
    nothing = torch.full((1, 1, 3), torch.nan)
    moved = emap(emap.state, emap.measure(nothing, pose(0.4), pose(0.4), dt=0.1))
    before, after = (emap.layer("grass", state=state)[0].isfinite().nonzero()[0] for state in (emap.state, moved))
    assert (before - after).tolist() == [4, 0]
    gone = emap.state._replace(validity=torch.zeros_like(emap.state.validity))
    assert emap.layer("grass", state=gone).isnan().all() and at_cell(emap, "grass") == 3.0


def test_configs_are_equal_in_any_order():
    a = ElevationMapConfig(channels={"a": "mean", "b": "color"})
    b = ElevationMapConfig(channels={"b": "color", "a": "mean"})
    assert a == b and hash(a) == hash(b)


def test_configs_with_channels_are_written_and_read(tmp_path):
    cfg = ElevationMapConfig(grid=GRID, channels={"rgb": "color", "terrain": ChannelConfig(kind="class", size=3)})
    cfg.save(tmp_path / "map.json")
    assert ElevationMapConfig.load(tmp_path / "map.json") == cfg
    (tmp_path / "map.yaml").write_text("channels:\n  grass: mean\n  terrain: {kind: class, names: [mud, stone]}\n")
    read = ElevationMapConfig.load(tmp_path / "map.yaml").channels
    assert read == {"grass": ChannelConfig(), "terrain": ChannelConfig(kind="class", names=("mud", "stone"))}


@pytest.mark.parametrize(
    "channels, error, words",
    [
        ([], TypeError, "cfg.channels: must be a dict by name, got list"),
        (
            {"elevation": "mean"},
            ValueError,
            "must have names that are words, and no layers of the map, got 'elevation'",
        ),
        ({"a b": "mean"}, ValueError, "must have names that are words"),
        ({"a": "median"}, ValueError, "channel.kind: must be one of mean, exponential, .*, got 'median'"),
        ({"a": 3}, TypeError, "cfg.channels..a..: must be a ChannelConfig, got int"),
        ({"a": {"speed": 1}}, ValueError, "cfg.channels..a...speed: is not a setting, got 'speed'; there are kind"),
        ({"a": {"kind": "color", "size": 4}}, ValueError, "channel.names: must name the 4 components"),
        ({"a": {"kind": "class"}}, ValueError, "channel.size: must be two or more of classes, got 1"),
        ({"a": {"names": ["x", "x"]}}, ValueError, "channel.names: must be different words without dots"),
        ({"a": {"rate": 0.0}}, ValueError, "channel.rate: must lie in .0, 1., got 0.0"),
        ({"a": {"half_life": -1.0}}, ValueError, "channel.half_life: must be a positive number"),
        (
            {"a": {"kind": "class", "size": 2, "dtype": "float16"}},
            ValueError,
            "channel.dtype: must be float32 for counts",
        ),
        ({"a": {"names": "road"}}, ValueError, "cfg.channels..a..: channel.names: must be a list of names, got 'road'"),
        ({"a": {"rate": "fast"}}, ValueError, "channel.rate: must lie in .0, 1., got 'fast'"),
        ({"a": {"dtype": "int8"}}, ValueError, "channel.dtype: must be one of float32, float16, got 'int8'"),
    ],
)
def test_refuses_settings(channels, error, words):
    with pytest.raises(error, match=words):
        ElevationMapConfig(channels=channels)


@pytest.mark.parametrize(
    "features, error, words",
    [
        ([], TypeError, "features: must be a dict by channel, got list"),
        (
            {"dino": torch.ones(1, 2)},
            KeyError,
            "features: must name channels of the map: grass, rgb, terrain, got 'dino'",
        ),
        ({"grass": [[1.0, 2.0]]}, TypeError, "features..grass..: must be a torch.Tensor, got list"),
        ({"grass": torch.ones(1, 3)}, ValueError, r"features..grass..: expected \(1, 2, 1\), got \(1, 3\)"),
        ({"rgb": torch.ones(1, 2, 4)}, ValueError, r"features..rgb..: expected \(1, 2, 3\), got \(1, 2, 4\)"),
        (
            {"rgb": torch.tensor([[[0.5, 1.5, 0.0]] * 2])},
            ValueError,
            "must be colours from 0 to 1, got 0.5, 1.5, 0; divide",
        ),
        (
            {"terrain": torch.ones(1, 2, 2)},
            ValueError,
            "must be probabilities of 2 classes that sum to 1, got 1, 1; apply",
        ),
        ({"terrain": torch.tensor([[[1.5, -0.5]] * 2])}, ValueError, "must be probabilities"),
        ({"grass": torch.ones(1, 2, dtype=torch.int64)}, TypeError, "features..grass..: must be float"),
    ],
)
def test_refuses_features_before_anything_changes(features, error, words):
    emap = make(grass=ChannelConfig(), rgb="color", terrain=ChannelConfig(kind="class", size=2))
    before = copy.deepcopy(emap.state_dict())
    with pytest.raises(error, match=words):
        emap.update(torch.tensor([[[0.05, 0.05, -1.0]] * 2]), pose(), pose(), dt=0.1, features=features)
    for name, value in emap.state_dict().items():
        assert name == "_extra_state" or torch.equal(value.nan_to_num(-7), before[name].nan_to_num(-7))


def test_a_map_without_channels_says_so():
    emap = ElevationMap(ElevationMapConfig(grid=GRID))
    with pytest.raises(KeyError, match="must name channels of the map: none: give the config channels"):
        emap.update(torch.zeros(1, 1, 3), pose(), pose(), dt=0.1, features={"rgb": torch.zeros(1, 1, 3)})
