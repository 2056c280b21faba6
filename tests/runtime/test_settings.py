"""Configs in the C library: the settings that follow from them, and what it refuses, in Python's words."""

import ctypes
import dataclasses
import json
import math

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
    LearnedTraversabilityConfig,
    OverlapConfig,
    RaycastConfig,
    RobotConfig,
    SensorConfig,
    SurfaceConfig,
    TraversabilityConfig,
)
from torchelev.kernels.registry import settings_of
from torchelev.pipeline import KERNELS
from torchelev.runtime import generate
from torchelev.runtime.library import CMap, LibraryError

SIZES = st.sampled_from([0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.15, 0.25])
POSITIVE = st.floats(0.01, 20.0)


@st.composite
def configs(draw):
    size, cells = draw(SIZES), st.integers(5, 150)
    grid = GridConfig(resolution=size, length_x=draw(cells) * size, length_y=draw(cells) * size)
    body = st.builds(BodyConfig, lower=st.tuples(*[st.floats(-1, 0)] * 3), upper=st.tuples(*[st.floats(0, 1)] * 3))
    edges = st.builds(EdgeConfig, min_points=st.integers(2, 9), margin=st.floats(0, 2), refinements=st.integers(2, 9))
    share = st.none() | st.floats(0, 1)
    base, higher = draw(st.floats(0, 2)), draw(st.floats(0, 2))
    overlap = st.builds(OverlapConfig, radius=POSITIVE, height=POSITIVE).map(
        lambda cfg: dataclasses.replace(cfg, base_height=base, max_base_height=base + higher)
    )
    critical = st.floats(0.01, 1.5) | st.just(math.inf)
    return ElevationMapConfig(
        grid=grid,
        sensor=SensorConfig(
            noise_factor=draw(st.floats(0, 1)),
            min_distance=draw(st.floats(0, 1)),
            max_distance=draw(st.floats(1.1, 90)),
            exclusion=draw(st.sampled_from([None, SensorConfig().exclusion])),
            body=draw(st.none() | body),
        ),
        drift=draw(
            st.none() | st.builds(DriftConfig, gate=POSITIVE, relief=st.floats(0, 0.1), min_traversability=share)
        ),
        fusion=FusionConfig(gate=draw(POSITIVE), relief=draw(st.floats(0, 1)), edges=draw(st.none() | edges)),
        raycast=draw(st.none() | st.builds(RaycastConfig, max_range=st.none() | st.floats(0.5, 30), gate=POSITIVE)),
        overlap=draw(st.none() | overlap),
        surface=SurfaceConfig(radius=draw(st.integers(1, 4))),
        traversability=draw(
            st.none()
            | st.builds(
                TraversabilityConfig,
                radius=st.floats(0.01, 0.5),
                critical_slope=critical,
                critical_step=critical,
                robot=st.sampled_from([None, RobotConfig()]),
            )
        ),
    )


@given(configs())
def test_settings_are_those_of_python(library, tmp_path_factory, cfg):
    path = tmp_path_factory.getbasetemp() / "map.json"
    cfg.save(path)
    emap = CMap(library, path, max_points=10)
    wanted = settings_of(KERNELS, cfg, ElevationMapConfig())
    library.settings_of_map.restype = ctypes.c_void_p
    found = ctypes.string_at(library.settings_of_map(emap._map), ctypes.sizeof(wanted))
    found, wanted = _numbers(type(wanted).from_buffer_copy(found)), _numbers(wanted)
    assert {name: (found[name], value) for name, value in wanted.items() if found[name] != value} == {}


def _numbers(settings):
    settings.surface.tile_memory = 0  # of GPUs alone
    groups = {name: getattr(settings, name) for name, _ in settings._fields_}
    return {
        (group, name): list(value) if isinstance(value := getattr(part, name), ctypes.Array) else value
        for group, part in groups.items()
        for name, _ in part._fields_
    }


def test_headers_are_up_to_date():
    for name, text in generate.headers().items():
        assert (generate.FOLDER / name).read_text() == text, "run python -m torchelev.runtime.generate"


CAPSULE = {"link": "leg", "start": [0.0, 0.0, 0.0], "end": [0.0, 0.0, -0.3], "radius": 0.05}
BOX = {"link": "base", "center": [0.0, 0.0, 0.0], "half_lengths": [0.2, 0.1, 0.1]}
BAD = [
    {"grid": {"resolution": -1.0}},
    {"grid": {"resolution": 0.3}},
    {"grid": {"resolution": 1e-11, "length_x": 1e-10, "length_y": 1e-10}},
    {"grid": {"resolution": "fine"}},
    {"grid": {"size": 3}},
    {"grids": {}},
    {"grid": None},
    {"grid": 4},
    {"sensor": {"noise_floor": 0.0}},
    {"sensor": {"noise_factor": -1e-05}},
    {"sensor": {"min_distance": 3.0, "max_distance": 2.0}},
    {"aging": {"variance_rate": -1.0}},
    {"drift": {"gain": 1.5}},
    {"drift": {"min_traversability": 1.5}},
    {"drift": {"min_points": 0}},
    {"fusion": {"gate": 0.0}},
    {"fusion": {"relief": -0.25}},
    {"fusion": {"max_support": "inf"}},
    {"fusion": {"max_variance": "inf"}},
    {"fusion": {"min_above": 0}},
    {"fusion": {"min_above": 300}},
    {"levels": {"max_levels": 9}},
    {"levels": {"max_levels": 0}},
    {"levels": {"min_gap": 0.0}},
    {"levels": {"min_gap": 400.0}},
    {"levels": {"max_step": 20.5}},
    {"levels": {"max_step": "inf"}},
    {"levels": {"max_blind": -1.0}},
    {"levels": {"min_support": "inf"}},
    {"levels": {"separation": "points"}},
    {"levels": {"gap": 0.4}},
    {"fusion": {"edges": {"min_points": 1}}},
    {"fusion": {"edges": {"margin": -1.0}}},
    {"fusion": {"edges": {"min_extreme": 0}}},
    {"fusion": {"edges": {"min_share": 0.0}}},
    {"raycast": {"min_time": -0.5}},
    {"raycast": {"min_incidence": 1.0}},
    {"raycast": {"max_range": 0.0}},
    {"raycast": {"max_range": 1e5}},
    {"raycast": {"min_support": "inf"}},
    {"raycast": {"gate": -3.0}},
    {"overlap": {"radius": 0.0}},
    {"overlap": {"base_height": -0.1}},
    {"overlap": {"base_height": 3.0}},
    {"surface": {"radius": 0}},
    {"surface": {"radius": 1001}},
    {"fusion": {"edges": {"refinements": 101}}},
    {"traversability": {"radius": 41.0}},
    {"traversability": {"radius": 0.0}},
    {"traversability": {"critical_step": 0.0}},
    {"traversability": {"critical_slope": 1.7}},
    {"torchelev_config": 2},
    {"sensor": {"body": {"capsules": []}}},
    {"sensor": {"body": {"capsules": [CAPSULE | {"radius": -1.0}]}}},
    {"sensor": {"body": {"capsules": [CAPSULE | {"color": 1}]}}},
    {"sensor": {"body": {"capsules": [CAPSULE], "padding": -0.5}}},
    {"sensor": {"body": {"boxes": [BOX | {"half_lengths": [0.1, 0.0, 0.1]}]}}},
    {"sensor": {"body": {"boxes": [BOX | {"quat_wxyz": [1.0, 1.0, 0.0, 0.0]}]}}},
]


@pytest.mark.parametrize("values", BAD, ids=json.dumps)
def test_bad_settings_are_refused_in_pythons_words(library, tmp_path, values):
    path = tmp_path / "map.json"
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError) as python:
        ElevationMapConfig.load(path)
    with pytest.raises(LibraryError) as c:
        CMap(library, path)
    assert str(c.value).removeprefix(f"{path}, ") == str(python.value).removeprefix(f"{path}: ")


NEEDS_PYTHON = {
    "learned": ElevationMapConfig(traversability=LearnedTraversabilityConfig()).to_dict(),
    "learned, in short": {"traversability": {"robot": {"length": 0.5}}},
    "filters": {"filters": [{"layer": "slope", "filter": "slope"}]},
}


@pytest.mark.parametrize("name", NEEDS_PYTHON)
def test_what_needs_python_is_refused_by_name(library, name):
    with pytest.raises(LibraryError, match="needs Python") as error:
        CMap(library, json.dumps(NEEDS_PYTHON[name]))
    assert error.value.status == 3


@pytest.mark.parametrize(
    "text",
    ["", "{", "[1]", '{"grid": }', '{"grid": {}, "grid": {}}', '{"a": 01}', "{} {}", '{"a": "\\ud800"}', "{" * 99],
)
def test_what_is_no_json_is_refused(library, tmp_path, text):
    path = tmp_path / "map.json"
    path.write_text(text)
    with pytest.raises(LibraryError) as error:
        CMap(library, path)
    assert error.value.status in (1, 2)
    with pytest.raises(ValueError):
        ElevationMapConfig.load(path)


def test_limits_are_checked(library):
    for name in ("max_points", "max_sensors", "num_threads"):
        with pytest.raises(LibraryError, match=f"limits.{name}: must be from 1"):
            CMap(library, "{}", **{name: 0})


@pytest.mark.parametrize(
    "text, words",
    [
        ('{"traversability": {"robot": 3, "radius": 0.1}}', "config.traversability.robot: must be a mapping, got int"),
        ('{"grid": {"length_x": 4000.0, "length_y": 4000.0}}', "grid: must have at most 2^26 cells"),
        ('{"raycast": {"max_range": 1e308}}', "raycast.max_range: rays of 0.04 m cells"),
    ],
)
def test_what_there_is_no_memory_or_meaning_for_is_refused(library, text, words):
    with pytest.raises(LibraryError) as error:
        CMap(library, text)
    assert words in str(error.value)
