"""Maps of the C library: the same bits as Python's CPU backend, along walks of many configs."""

import ctypes
import json
import os
import re

import numpy as np
import pytest
import torch

import torchelev as te
from tests.helpers import pose, random_poses, seen_from, small_config
from torchelev.errors import require
from torchelev.kernels.registry import PACKAGE
from torchelev.kernels.structs import members
from torchelev.maps.buffers import name_tensors
from torchelev.pipeline import update_by_tensors
from torchelev.runtime.library import STATISTICS, CMap, LibraryError
from torchelev.stages.recenter.stage import recenter
from torchelev.state import LAYERS, Statistics

GRID = te.GridConfig(resolution=0.05, length_x=4.0, length_y=3.0)
CONFIGS = {
    "default": te.ElevationMapConfig(grid=GRID),
    "10 m at 4 cm": te.ElevationMapConfig(),
    "bare": te.ElevationMapConfig(grid=GRID, drift=None, raycast=None, overlap=None, traversability=None),
    "without edges": te.ElevationMapConfig(grid=GRID, fusion=te.FusionConfig(edges=None)),
    "body": te.ElevationMapConfig(grid=GRID, sensor=te.SensorConfig(body=te.BodyConfig(), exclusion=None)),
    "wide": te.ElevationMapConfig(
        grid=GRID,
        surface=te.SurfaceConfig(radius=2),
        raycast=te.RaycastConfig(max_range=1.5, min_time=0.0),
        traversability=te.TraversabilityConfig(radius=0.2),
    ),
    "no window": small_config((1, 300), 0.02),
}


def instants(sensors=1, num=12, far=0.0, number=3000):
    """Points (S, N, 3), poses (S, 4, 4) and (4, 4), and dt of a walk past a box that goes away, with a jump."""
    rng = np.random.default_rng(sensors)
    for k in range(num):
        x = far + 0.15 * k + (30 if k == 9 else 0)
        T_map_sensor = random_poses(rng, sensors)
        T_map_sensor[:, 0, 3] += x
        ground = rng.uniform(-3, 3, (number + k, 3)) + [x, 0, 0]
        in_box = (abs(ground[:, 0] - far - 1) < 0.4) & (k < 6)
        ground[:, 2] = 0.05 * np.sin(3 * (ground[:, 0] - far)) + 0.4 * in_box + 0.01 * rng.normal(size=len(ground))
        points = torch.stack([seen_from(T[None], ground, torch.float32)[0] for T in T_map_sensor])
        points[:, ::17] = torch.nan
        points[:, 1::19] = 1e30
        yield points, T_map_sensor, None if k == 4 else T_map_sensor[0], 0.0 if k == 3 else 0.1 + k / 7


def assert_equal(found, emap):
    for name, value in name_tensors(emap.state).items():
        wanted = value[0].numpy()
        assert found.tensor(name, wanted.dtype).tobytes() == wanted.tobytes(), name


def update(emap, points, T_map_sensor, T_map_base, dt, **more):
    more = {name: torch.as_tensor(value)[None] for name, value in more.items()}
    emap.update(points[None], T_map_sensor[None], None if T_map_base is None else T_map_base[None], dt, **more)


def numpy(*values):
    return [value.numpy() if isinstance(value, torch.Tensor) else value for value in values]


@pytest.mark.slow(2)
@pytest.mark.parametrize("sensors", [1, 3])
@pytest.mark.parametrize("name", CONFIGS)
def test_bits_are_those_of_python(library, tmp_path, name, sensors):
    cfg = CONFIGS[name]
    cfg.save(tmp_path / "map.json")
    emap = te.ElevationMap(cfg)
    require(emap.backend.name == "CPU", "backend", "must be CPU", emap.backend, "install g++")
    found = CMap(library, tmp_path / "map.json", num_threads=2)
    rng = np.random.default_rng(0)
    for k, instant in enumerate(instants(sensors)):
        more = {}
        if k % 3 == 1:
            more["variance"] = rng.uniform(1e-5, 1e-3, instant[0].shape[:2]).astype(np.float32)
        if k % 3 == 2:
            L = 0.01 * rng.normal(size=(sensors, 6, 6))
            more["pose_covariance"] = L @ L.swapaxes(1, 2)
        if k == 8:
            emap.reset(), found.reset()
        update(emap, *instant, **more)
        found.update(*numpy(*instant), **more)
        assert_equal(found, emap)


def test_bits_of_a_body_of_links(library):
    body = te.RobotBody(
        capsules=[te.Capsule(link="leg", start=(0, 0, 0), end=(0, 0, -0.4), radius=0.1)],
        boxes=[te.Box(link="trunk", center=(0.1, 0, 0), half_lengths=(0.3, 0.2, 0.1), quat_wxyz=(0.8, 0.6, 0, 0))],
    )
    cfg = te.ElevationMapConfig(grid=GRID, sensor=te.SensorConfig(body=body))
    emap, found = te.ElevationMap(cfg), CMap(library, json.dumps(cfg.to_dict()))
    assert found.links == ["leg", "trunk"] == list(body.links)
    rng, own = np.random.default_rng(0), 0
    for points, T_map_sensor, _, dt in instants(2, 5, number=2000):
        links = random_poses(rng, 2, height=(-0.5, 0.0))
        points[:, :400] = torch.from_numpy(rng.normal(0, 0.3, (2, 400, 3)))
        update(emap, points, T_map_sensor, T_map_sensor[0], dt, T_base_links=links)
        found.update(*numpy(points, T_map_sensor, T_map_sensor[0], dt), T_base_links=links.numpy())
        assert_equal(found, emap)
        own += int(emap.statistics.rejected_body)
    assert own > 50
    T, points = np.eye(4), np.zeros((1, 5, 3))
    for more, words in [
        ({}, "T_base_links: must be given: the poses of 2 links"),
        ({"T_base_links": 2 * links.numpy()}, "T_base_links: must be rigid"),
    ]:
        with pytest.raises(LibraryError, match=words):
            found.update(points, T[None], T, 0.1, **more)
    with pytest.raises(LibraryError, match="T_map_base: is required to pose the links"):
        found.update(points, T[None], None, 0.1, T_base_links=links.numpy())
    with pytest.raises(LibraryError, match="T_base_links: must be left out"):
        CMap(library, "{}").update(points, T[None], T, 0.1, T_base_links=links.numpy())


def test_bits_100_km_from_the_origin(library):
    emap, found = te.ElevationMap(CONFIGS["default"]), CMap(library, json.dumps(CONFIGS["default"].to_dict()))
    for instant in instants(2, far=1e5):
        update(emap, *instant)
        found.update(*numpy(*instant))
        assert_equal(found, emap)
    assert emap.state.validity.any()


def test_threads_and_limits_change_nothing(library):
    maps = [CMap(library, "{}", max_points=12000, max_sensors=3, num_threads=threads) for threads in (1, 2, 5)]
    maps.append(CMap(library, "{}", max_points=9100, max_sensors=3))
    for instant in instants(3, 5):
        for emap in maps:
            emap.update(*numpy(*instant))
        for name in LAYERS:
            assert len({emap.tensor(name, np.uint8).tobytes() for emap in maps}) == 1, name


def test_tensors_agree(library):
    emap, found = te.ElevationMap(CONFIGS["default"]), CMap(library, json.dumps(CONFIGS["default"].to_dict()))
    for instant in instants(1, 6):
        with torch.no_grad():
            points, T_map_sensor, T_map_base, dt = instant
            base = None if T_map_base is None else T_map_base[None]
            inputs = emap._check_inputs(points[None], T_map_sensor[None], base, dt, None, None, None, None)
            update_by_tensors(emap.state, inputs, emap.cfg, None)
        found.update(*numpy(*instant))
    same = found.tensor("validity", bool) == emap.state.validity.numpy().ravel()
    close = np.abs(found.tensor("elevation", np.float32) - emap.state.elevation.numpy().ravel()) < 1e-4
    assert same.mean() > 0.999 and close.mean() > 0.999


@pytest.fixture
def walked(library):
    """A map in Python, and the same in C."""
    cfg = CONFIGS["default"]
    emap, found = te.ElevationMap(cfg), CMap(library, json.dumps(cfg.to_dict()))
    for instant in instants(1, 5):
        update(emap, *instant)
        found.update(*numpy(*instant))
    return emap, found


@pytest.mark.parametrize("name", ["elevation", "variance", "time", "upper_bound", "traversability"])
def test_layers_are_those_of_python(walked, name):
    emap, found = walked
    assert np.array_equal(found.layer(name), emap.layer(name)[0].numpy(), equal_nan=True)
    xy = np.random.default_rng(0).uniform(-2.5, 2.5, (400, 2))
    for mode in ("bilinear", "nearest"):
        values, known = emap.sample(torch.from_numpy(xy)[None], name, mode)
        mine, mine_known = found.sample(name, xy, mode)
        assert np.array_equal(mine_known, known[0].numpy()) and known.any()
        np.testing.assert_allclose(mine, values[0].numpy(), atol=1e-6)


@pytest.mark.parametrize("axis", "xyz")
def test_normals_are_those_of_python_to_the_last_bit_but_one(walked, axis):
    emap, found = walked
    wanted = emap.layer(f"normal_{axis}")[0].numpy()
    np.testing.assert_allclose(found.layer(f"normal_{axis}"), wanted, atol=1.2e-7)  # torch rounds roots otherwise


def test_statistics_are_those_of_python(walked):
    emap, found = walked
    assert {m.name: m.type == "float" for m in members(Statistics)} == STATISTICS
    for name, value in found.statistics().items():
        assert value == getattr(emap.state.statistics, name).item(), name
    corner = emap.state.corner[0].double() * emap.cfg.grid.resolution
    assert found.corner == tuple(corner.tolist()) and found.resolution == emap.cfg.grid.resolution
    text = (PACKAGE / "runtime/include/torchelev.h").read_text()
    struct = re.search(r"typedef struct \{([^}]*)\} torchelev_statistics", text)[1]
    assert tuple(re.findall(r"(?:int64_t|double) (\w+);", struct)) == Statistics._fields


def test_move_is_what_an_update_begins_with(walked):
    emap, found = walked
    T = pose((1.3, -0.4, 0.7))
    found.move(T[0].numpy())
    m = emap.measure(torch.zeros(1, 0, 3), T, T, 0.0)
    state = recenter(emap.state, m, emap.cfg.grid)
    for name in ("corner", "elevation", "validity", "variance", "time"):
        wanted = getattr(state, name)[0].numpy()
        assert np.array_equal(found.tensor(name, wanted.dtype), wanted.ravel()), name


# Bad input -----------------------------------------------------------------------------------------------------------


def bad_pose(**entries):
    T = np.eye(4)
    for place, value in entries.items():
        T[int(place[1]), int(place[2])] = value
    return T


POSES = {
    "nan": bad_pose(p03=np.nan),
    "scaled": 2 * np.eye(4),
    "mirrored": bad_pose(p11=-1),
    "transposed": bad_pose(p30=4.0),
    "last row": bad_pose(p31=4.0, p13=2.0),
    "far": bad_pose(p03=1e10),
}


@pytest.mark.parametrize("name", POSES)
def test_bad_poses_are_refused_in_pythons_words(walked, name):
    emap, found = walked
    T, points = torch.from_numpy(POSES[name])[None], torch.zeros(1, 5, 3)
    before = found.tensor("elevation", np.uint8)
    with pytest.raises(ValueError) as python:
        emap.update(points, T, None, 0.1)
    for call in (lambda: found.update(points.numpy(), T.numpy(), None, 0.1), lambda: found.move(T[0].numpy())):
        with pytest.raises(LibraryError) as c:
            call()
        assert str(c.value).replace("base", "sensor") == str(python.value)
    assert np.array_equal(found.tensor("elevation", np.uint8), before)


def test_bad_input_is_refused(walked):
    _, found = walked
    points, T, C = np.zeros((1, 5, 3)), np.eye(4)[None], np.eye(6)[None]
    before = {name: found.tensor(name, np.uint8) for name in LAYERS}
    for arguments, words in [
        ((points, T, None, -0.1), "dt: must be finite and not negative, got -0.1"),
        ((points, T, None, np.nan), "dt: must be finite and not negative, got nan"),
        ((np.zeros((5, 5, 3)), np.eye(4)[None].repeat(5, 0)), "input.num_sensors: must be from 1 to 4, got 5"),
        ((np.zeros((1, 140000, 3)), T), "input.num_points: must be from 0 to 131072"),
        ((points, T, None, 0.1, None, -C), "pose_covariance: must have no negative eigenvalue"),
        ((points, T, None, 0.1, None, C + np.eye(6, k=1)), "pose_covariance: must be symmetric"),
        ((points, T, None, 0.1, None, C * np.nan), "pose_covariance: must be finite"),
    ]:
        with pytest.raises(LibraryError, match=re.escape(words)):
            found.update(*arguments)
    assert all(np.array_equal(found.tensor(name, np.uint8), value) for name, value in before.items())
    with pytest.raises(LibraryError, match="layer: must be one of elevation, .* got 'height'"):
        found.layer("height")
    with pytest.raises(LibraryError, match="mode: must be one of bilinear, nearest"):
        found.sample("elevation", [[0, 0]], "cubic")
    with pytest.raises(LibraryError, match="name: must be a tensor of MapState"):
        found.tensor("height", np.uint8)


def test_null_is_refused(library, walked):
    assert library.torchelev_map_update(None, None) == 1
    assert library.torchelev_last_error() == b"map: must be given, got null; see torchelev.h"
    assert library.torchelev_map_create(None, None, None) == 1
    assert library.torchelev_map_layer(walked[1]._map, None, None, ctypes.c_size_t(0)) == 1
    library.torchelev_map_free(None), library.torchelev_scan_free(None)


# Files ---------------------------------------------------------------------------------------------------------------


def test_a_saved_map_continues(library, walked, tmp_path):
    emap, found = walked
    found.save(tmp_path / "a.safetensors")
    other = CMap(library, json.dumps(emap.cfg.to_dict()))
    other.load(tmp_path / "a.safetensors")
    points, T_map_sensor, T_map_base, dt = list(instants(1, 8))[-1]
    update(emap, points, T_map_sensor, T_map_base, dt)
    other.update(*numpy(points, T_map_sensor, T_map_base, dt))
    assert_equal(other, emap)
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


def with_corner(saved, number):
    """A file of a saved map with another corner, whose numbers are its first."""
    first = 8 + int.from_bytes(saved[:8], "little")
    return saved[:first] + number.to_bytes(8, "little", signed=True) + saved[first + 8 :]


def test_a_link_is_followed_and_no_other_file_is_touched(walked, tmp_path):
    _, found = walked
    target, link = tmp_path / "a.safetensors", tmp_path / "link"
    link.symlink_to(target)
    target.write_bytes(b"old")
    found.save(link)
    assert link.is_symlink() and target.stat().st_size > 1000 and target.stat().st_mode & 0o777 == 0o644
    assert {path.name for path in tmp_path.iterdir()} == {"a.safetensors", "link"}


def test_a_forked_child_maps_on_several_threads(library):
    wanted = CMap(library, "{}", num_threads=2)
    wanted.update(*numpy(*next(instants())))
    child = os.fork()
    if child == 0:
        emap = CMap(library, "{}", num_threads=2)
        emap.update(*numpy(*next(instants())))
        os._exit(0 if np.array_equal(emap.layer("elevation"), wanted.layer("elevation"), equal_nan=True) else 1)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize(
    "name, value",
    [
        ("points", np.zeros((5, 3))),
        ("T_map_sensor", np.eye(4)),
        ("T_map_base", np.eye(3)),
        ("variance", np.zeros(5)),
        ("pose_covariance", np.eye(6)),
    ],
)
def test_other_shapes_are_refused_before_c_reads_them(walked, name, value):
    given = {"points": np.zeros((1, 5, 3)), "T_map_sensor": np.eye(4)[None], "dt": 0.1, name: value}
    with pytest.raises(ValueError, match=f"{name}: expected"):
        walked[1].update(**given)


def test_another_map_is_refused(library, walked, tmp_path):
    _, found = walked
    path = tmp_path / "a.safetensors"
    found.save(path)
    other = CMap(library, json.dumps(CONFIGS["without edges"].to_dict()))
    with pytest.raises(LibraryError, match='another config, "fusion.edges" instead of "fusion.edges null"'):
        other.load(path)
    height = next(value for value in found.tensor("elevation", np.float32) if value != 0)
    for damage in (
        lambda b: b[:-1],
        lambda b: b + b"x",
        lambda b: b[:5],
        lambda b: b"",
        lambda b: b"\xff" * 9 + b[9:],
        lambda b: b.replace(b'"version":"1"', b'"version":"2"'),
        lambda b: b.replace(b"F32", b"I32"),
        lambda b: b.replace(height.tobytes(), np.float32(np.nan).tobytes()),
        lambda b: with_corner(b, -(2**63)),
    ):
        path.write_bytes(damage(path.read_bytes()))
        before = found.tensor("elevation", np.uint8)
        with pytest.raises(LibraryError) as error:
            found.load(path)
        assert error.value.status == 2 and str(path) in str(error.value)
        assert np.array_equal(found.tensor("elevation", np.uint8), before)
        found.save(path)
    for call in (found.save, found.load):
        with pytest.raises(LibraryError, match=r"cannot be (read|written) \(No such file"):
            call(tmp_path / "none" / "a.safetensors")


@pytest.mark.parametrize("method", ["linear", "nearest"])
@pytest.mark.parametrize("number", [1, 2, 5])
def test_ground_points_and_cleared_cells_as_in_python(library, method, number):
    emap, found = te.ElevationMap(CONFIGS["default"]), CMap(library, json.dumps(CONFIGS["default"].to_dict()))
    for points, T_map_sensor, T_map_base, dt in instants(num=2):
        update(emap, points, T_map_sensor, T_map_base, dt)
        found.update(*numpy(points, T_map_sensor, T_map_base, dt))
    feet = np.random.default_rng(number).uniform(-0.8, 0.8, (number, 3)) * [1, 1, 0.1]
    center, known = np.array([0.3, -0.2]), []
    tolerance = {"elevation": 1e-5, "traversability": 2e-3}  # a rating by tensors rounds otherwise near level ground
    for step in ("clear", "initialize"):
        if step == "clear":
            emap.clear_around(torch.from_numpy(center)[None], 0.7), found.clear_around(center, 0.7)
        else:
            emap.initialize(torch.from_numpy(feet)[None], method), found.initialize(feet, method)
        for name in LAYERS:
            wanted = getattr(emap.state, name)[0].numpy()
            actual, atol = found.tensor(name, wanted.dtype), tolerance.get(name, 3e-4)
            np.testing.assert_allclose(actual, wanted.ravel(), atol=atol, err_msg=name)
        known.append(int(emap.validity.sum()))
        if step == "clear":
            away = np.linalg.norm(emap.cell_centers()[0].numpy() - center, axis=-1)
            assert not emap.validity[0].numpy()[away <= 0.7].any()
    assert 500 < known[0] < known[1]


def test_bad_ground_points_and_places_are_refused_in_pythons_sentences(library):
    emap, found = te.ElevationMap(CONFIGS["default"]), CMap(library, json.dumps(CONFIGS["default"].to_dict()))
    none, unknown, some = np.zeros((0, 3)), np.full((2, 3), np.nan), np.zeros((2, 3))
    for feet, method in [(none, "linear"), (unknown, "linear"), (some, "cubic")]:
        with pytest.raises(ValueError) as wanted:
            emap.initialize(torch.from_numpy(feet)[None], method)
        with pytest.raises(LibraryError) as actual:
            found.initialize(feet, method)
        assert str(actual.value).split(":")[0] == str(wanted.value).split(":")[0]
        assert str(actual.value).split("; ")[1] == str(wanted.value).split("; ")[1]
    for center, radius in [([np.nan, 0], 1.0), ([0, 0], 0.0), ([0, 0], np.inf)]:
        with pytest.raises(LibraryError, match="center: must be finite|radius: must be positive"):
            found.clear_around(center, radius)
