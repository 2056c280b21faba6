"""The whole configuration."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchelev import (
    BodyConfig,
    DriftConfig,
    EdgeConfig,
    ElevationMapConfig,
    FusionConfig,
    GridConfig,
    RaycastConfig,
    SensorConfig,
)
from torchelev.config import differing_fields
from torchelev.stages.visibility.kernel import settings

SOME = [
    ElevationMapConfig(),
    ElevationMapConfig(drift=None, raycast=None, overlap=None, traversability=None),
    ElevationMapConfig(sensor=SensorConfig(body=BodyConfig(), exclusion=None), fusion=FusionConfig(edges=None)),
    ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=3.0), raycast=RaycastConfig(max_range=4.0)),
]


@pytest.mark.parametrize("cfg", SOME)
def test_dict_round_trip(cfg):
    assert ElevationMapConfig.from_dict(cfg.to_dict()) == cfg
    assert hash(ElevationMapConfig.from_dict(cfg.to_dict())) == hash(cfg)


def test_left_out_keeps_its_default():
    cfg = ElevationMapConfig.from_dict({"drift": {"gain": 0.5}, "raycast": None})
    assert cfg == ElevationMapConfig(drift=DriftConfig(gain=0.5), raycast=None)


def test_yaml_numbers_become_floats_and_lists_tuples():
    cfg = ElevationMapConfig.from_dict({"grid": {"length_x": 8}, "sensor": {"body": {"lower": [-1.0, -1.0, -1.0]}}})
    assert isinstance(cfg.grid.length_x, float) and cfg.sensor.body.lower == (-1.0, -1.0, -1.0)


@pytest.mark.parametrize(
    "values, named",
    [
        ({"grit": {}}, "config.grit"),
        ({"grid": {"size": 3}}, "config.grid.size"),
        ({"grid": 3}, "config.grid"),
        ({"grid": None}, "config.grid"),
        ({"grid": {"resolution": "4 cm"}}, "config.grid.resolution"),
        ({"grid": {"resolution": -1}}, "grid.resolution"),
        ({"fusion": {"edges": {"sharp": 1}}}, "config.fusion.edges.sharp"),
        ([], "config"),
    ],
)
def test_refuses_and_names_the_field(values, named):
    with pytest.raises(ValueError, match=named.replace(".", r"\.")):
        ElevationMapConfig.from_dict(values)


def test_configs_are_frozen_and_keyword_only():
    with pytest.raises(dataclasses.FrozenInstanceError):
        ElevationMapConfig().grid.resolution = 1.0
    with pytest.raises(TypeError):
        GridConfig(0.1)


@pytest.mark.parametrize(
    "bad",
    [dict(grid=None), dict(grid={"resolution": 0.1}), dict(sensor=GridConfig()), dict(drift=False)]
    + [dict(raycast=RaycastConfig), dict(grid=ElevationMapConfig()), dict(surface=None)],
)
def test_a_stage_takes_its_own_config_alone(bad):
    with pytest.raises(TypeError, match=rf"cfg\.{next(iter(bad))}: must be a \w+Config"):
        ElevationMapConfig(**bad)


def test_edges_take_their_own_config_alone():
    with pytest.raises(TypeError, match=r"fusion\.edges: must be an EdgeConfig or None, got True"):
        FusionConfig(edges=True)


@pytest.mark.parametrize("name", ["gate", "scan_variance_floor", "max_variance"])
def test_fusion_refuses(name):
    with pytest.raises(ValueError, match=rf"fusion\.{name}: must be positive"):
        FusionConfig(**{name: 0.0})


@pytest.mark.parametrize("name", ["relief", "max_support"])
@pytest.mark.parametrize("value", [-1.0, float("inf"), float("nan")])
def test_fusion_refuses_what_is_negative_or_not_finite(name, value):
    with pytest.raises(ValueError, match=rf"fusion\.{name}: must be finite and not negative"):
        FusionConfig(**{name: value})


@pytest.mark.parametrize("name", ["scan_variance_floor", "max_variance"])
def test_variances_are_finite(name):
    with pytest.raises(ValueError, match=rf"fusion\.{name}: must be finite"):
        FusionConfig(**{name: float("inf")})


def test_rays_reach_over_no_more_cells_than_a_table_has():
    grid = GridConfig(resolution=0.04, length_x=4.0, length_y=4.0)
    farthest = ElevationMapConfig(grid=grid, raycast=RaycastConfig(max_range=2**14 * 0.04))
    own = settings(farthest)
    assert own["ranges"] * own["azimuths"] < 2**31 and len(own["widen"]) == len(settings(ElevationMapConfig())["widen"])
    longest = GridConfig(resolution=0.1, length_x=4000.0, length_y=1.0)
    for window, rays in ((grid, RaycastConfig(max_range=1000.0)), (longest, RaycastConfig())):
        with pytest.raises(
            ValueError, match=r"raycast\.max_range: .* reach over at most 16,384 of them, got 2.,... cells"
        ):
            ElevationMapConfig(grid=window, raycast=rays)


@pytest.mark.parametrize("bad", [dict(refinements=1), dict(min_points=2.5), dict(min_extreme=0), dict(min_share=0.0)])
def test_edges_refuse(bad):
    with pytest.raises(ValueError, match=rf"fusion\.edges\.{next(iter(bad))}"):
        EdgeConfig(**bad)


@pytest.mark.parametrize(
    "bad",
    [
        dict(min_time=-1.0),
        dict(min_incidence=1.0),
        dict(min_incidence=-0.1),
        dict(max_range=-1.0),
        dict(max_range=float("inf")),
        dict(min_support=float("nan")),
        dict(gate=0.0),
    ],
)
def test_raycast_refuses(bad):
    with pytest.raises(ValueError, match=f"raycast.{next(iter(bad))}"):
        RaycastConfig(**bad)


@given(st.floats(0.1, 0.9), st.booleans())
def test_differing_fields(gain, body):
    a = ElevationMapConfig()
    b = dataclasses.replace(a, drift=DriftConfig(gain=gain))
    names = ["drift.gain"]
    if body:
        b, names = dataclasses.replace(b, sensor=SensorConfig(body=BodyConfig())), [*names, "sensor.body"]
    assert differing_fields(a.to_dict(), b.to_dict()) == names
    assert differing_fields(a.to_dict(), a.to_dict()) == []


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"drift_gate": 0.5}, "traversability.drift_gate: is not a setting.*there are radius"),
        (
            {"robot": {"length": 0.7}, "criticalstep": 3},
            "criticalstep: is not a setting.*robot, weights",
        ),
    ],
)
def test_of_two_kinds_of_head_the_settings_tell_which_is_meant(values, words):
    with pytest.raises(ValueError, match=words):
        ElevationMapConfig.from_dict({"traversability": values})
