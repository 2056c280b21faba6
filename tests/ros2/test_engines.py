"""Both engines of a node: the same map, files and sentences; and what is published of it."""

import subprocess
import sys

import numpy as np
import pytest

import torchelev as te
from tests.levels.walks import line, look
from tests.runtime.test_maps import instants
from torchelev.frames.quaternions import to_rotation
from torchelev.io.grid_map import from_grid_map, to_grid_map
from torchelev.io.occupancy import to_occupancy_grid
from torchelev.levels import LAYERS as CEILINGS
from torchelev.ros2 import outputs
from torchelev.ros2.engine import SensorInput, thinned
from torchelev.ros2.engines import make_engine
from torchelev.ros2.settings import NodeSettings
from torchelev.runtime.library import build_library
from torchelev.sim.exact import covered_scenes

CFG = {"grid": {"resolution": 0.05, "length_x": 4.0, "length_y": 3.0}, "drift": None}
LAYERS = ("elevation", "variance", "traversability", "upper_bound")


@pytest.fixture(scope="module")
def library():
    return build_library()._name


def engine_of(kind, library, **settings):
    return make_engine(CFG, NodeSettings(engine=kind, library=library, **settings))


def walk(engine, num=4, **more):
    for points, T_map_sensor, T_map_base, dt in instants(1, num):
        engine.update(SensorInput(points[0].numpy(), T_map_sensor[0].numpy(), T_map_base.numpy(), dt, **more))
    return T_map_base.numpy()


@pytest.fixture(scope="module")
def engines(library):
    both = [engine_of(kind, library) for kind in ("torch", "library")]
    for engine in both:
        walk(engine)
    return both


def test_both_give_the_same(engines):
    torch, c = engines
    assert torch.window() == c.window() and torch.statistics() == c.statistics()
    for name in LAYERS:
        assert np.array_equal(torch.layer(name), c.layer(name), equal_nan=True) and np.isfinite(c.layer(name)).any()
    T = walk(engine_of("library", build_library()._name), 1)
    assert torch.scan(T).tobytes() == c.scan(T).tobytes() and len(c.scan(T)) == 187
    assert torch.diagnose() == [] == c.diagnose()


def test_both_publish_ground_ceiling_and_clearance(library):
    cfg = {"grid": {"resolution": 0.1, "length_x": 6.0, "length_y": 6.0}, "levels": {"max_levels": 3}}
    layers, scene, maps = ("elevation", *CEILINGS), covered_scenes.bridge(), []
    for kind in ("torch", "library"):
        engine = make_engine(cfg, NodeSettings(engine=kind, library=library, layers=layers))
        for k, place in enumerate(line((0.0, -1.5, 0.0), (0.0, 0.5, 0.0), 4)):
            points, T_map_sensor, T_map_base = look(scene, *place, seed=k)
            engine.update(SensorInput(points[0].numpy(), T_map_sensor[0].numpy(), T_map_base[0].numpy(), 0.2))
        maps.append(from_grid_map(outputs.grid_map(engine, layers)).layers)
        assert outputs.map_cloud(engine, layers).names == ["x", "y", "z", *CEILINGS]
        clearance = engine.layer("clearance")
        costs = outputs.costmap(engine, 0.5, 2.5).data.reshape(clearance.shape[::-1]).T
        assert (costs[clearance < 2.49] == 100).all() and (clearance < 2.49).any()
        assert np.array_equal(outputs.costmap(engine, 0.5, 0.0).data, outputs.costmap(engine, 0.5).data)
    for name in layers:
        np.testing.assert_allclose(maps[0][name], maps[1][name], rtol=0, atol=2e-5, err_msg=name)
    assert np.nanmedian(maps[1]["ceiling"]) == pytest.approx(12 * covered_scenes.RISE - 0.25, abs=0.02)


def flat(low, high, height):
    """Points of a horizontal surface at low < x < high."""
    x, y = np.mgrid[low:high:0.02, -1.0:1.0:0.02] + 0.01
    return np.stack([x, y, np.full_like(x, height)], -1).reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("kind", ["torch", "library"])
def test_the_costmap_is_lethal_where_a_ceiling_is_too_low(library, kind):
    """A board at 0.5 m sags to 0.3 m; elsewhere nobody looked up."""
    levels = {"min_gap": 0.4, "separation": "gap"}
    cfg = CFG | {"raycast": None, "sensor": {"exclusion": None}, "levels": levels}
    cfg["grid"] = {"resolution": 0.1, "length_x": 4.0, "length_y": 3.0}
    engine, T = make_engine(cfg, NodeSettings(engine=kind, library=library)), np.eye(4)
    T[2, 3] = 0.45
    for points in (np.concatenate([flat(-1.0, 1.0, 0.0), flat(0.0, 0.5, 0.5)]), flat(0.0, 0.5, 0.3)):
        engine.update(SensorInput(points - T[:3, 3].astype(np.float32), T, T, 0.2))
    clearance, t = engine.layer("clearance"), engine.layer("traversability")
    is_low = np.abs(clearance - 0.3) < 0.01
    assert is_low.sum() == np.isfinite(clearance).sum() == 5 * 20 and (t[is_low] > 0.9).all()
    grid = outputs.costmap(engine, 0.5)
    expected = np.where(is_low, 100, np.where(np.isnan(t), -1, 0))
    assert grid.data.reshape(30, 40).T.tolist() == expected.tolist() and (expected == 0).sum() > 250
    if kind == "torch":
        assert np.array_equal(grid.data, to_occupancy_grid(engine._map).data)


@pytest.mark.parametrize("kind", ["torch", "library"])
@pytest.mark.parametrize("levels", [{}, {"levels": {"max_levels": 1}}])
def test_a_robots_height_needs_ceilings(library, kind, levels):
    cfg = {"grid": {"length_x": 2.0, "length_y": 2.0}, **levels}
    assert make_engine(cfg, NodeSettings(engine=kind, library=library)).levels is None
    with pytest.raises(ValueError, match="robot_height: needs a map with levels"):
        make_engine(cfg, NodeSettings(engine=kind, library=library, robot_height=0.6))


def test_pytorchs_diagnosis_runs_beside_updates(library, monkeypatch):
    engine, c = (engine_of(kind, library) for kind in ("torch", "library"))
    millimetres = SensorInput(
        1e3 * np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32), np.eye(4), np.eye(4), 0.1
    )
    for one in (engine, c):
        one.update(millimetres)
    assert engine.diagnose() == []
    engine._diagnosis._running.result(timeout=20)
    assert engine.diagnose() == engine._map.diagnose() != []
    assert "millimetres" in engine.diagnose()[0] and engine.diagnose()[0] == c.diagnose()[0]
    engine.reset()
    assert engine.diagnose() != [], "for some seconds"
    monkeypatch.setattr(engine._diagnosis, "PAUSE", 0.0)
    engine.diagnose()
    engine._diagnosis._running.result(timeout=20)
    assert engine.diagnose() == []


@pytest.mark.parametrize("k", [0, 1], ids=["torch", "library"])
def test_unknown_layers_are_refused(engines, k):
    with pytest.raises(ValueError, match="^layer: must be .*elevaton"):
        engines[k].layer("elevaton")


@pytest.mark.parametrize("kind", ["torch", "library"])
def test_saved_maps_go_on(library, tmp_path, kind):
    engine, other = engine_of(kind, library), engine_of(kind, library)
    walk(engine)
    path = tmp_path / "map.saved"
    engine.save(path)
    other.load(path)
    assert np.array_equal(engine.layer("elevation"), other.layer("elevation"), equal_nan=True)
    engine.reset()
    assert np.isnan(engine.layer("elevation")).all()
    wider = make_engine({"grid": {"length_x": 2.0, "length_y": 2.0}}, NodeSettings(engine=kind, library=library))
    with pytest.raises(ValueError):
        wider.load(path)
    with pytest.raises((ValueError, OSError)):
        engine.load(tmp_path / "none")


def test_outputs_are_those_of_python(engines, library):
    torch, c = engines
    emap = torch._map
    mine = from_grid_map(outputs.grid_map(c, LAYERS))
    wanted = from_grid_map(to_grid_map(emap, layers=LAYERS))
    for name in LAYERS:
        assert np.array_equal(mine.layers[name], wanted.layers[name], equal_nan=True)
    np.testing.assert_allclose(mine.center[:2], wanted.center[:2], atol=1e-9)
    grid, expected = outputs.costmap(c, 0.4), to_occupancy_grid(emap, min_traversability=0.4)
    assert np.array_equal(grid.data, expected.data) and {-1, 100} < set(grid.data.tolist())
    assert grid.info.width == expected.info.width
    np.testing.assert_allclose(grid.info.origin.position, expected.info.origin.position, atol=1e-6)


def test_the_map_as_points(engines):
    cloud = outputs.map_cloud(engines[1], LAYERS)
    elevation, centers = engines[0].layer("elevation"), engines[0]._map.cell_centers()[0].numpy()
    known = np.isfinite(elevation)
    assert cloud.names == ["x", "y", "z", "variance", "traversability", "upper_bound"]
    np.testing.assert_allclose(cloud.data[:, :2], centers[known], atol=1e-6)
    assert np.array_equal(cloud.data[:, 2], elevation[known])


def test_outputs_keep_their_rates():
    schedule = outputs.Schedule()
    times = [k for k in range(1000) if schedule.is_due("map", 50.0, 0.003 * k)]
    assert len(times) == pytest.approx(150, abs=1)
    assert not schedule.is_due("never", 0.0, 1.0)
    assert schedule.is_due("map", 50.0, 100.0) and not schedule.is_due("map", 50.0, 100.01), "no burst after a pause"


def test_large_clouds_are_thinned():
    points = np.zeros((1001, 3), np.float32)
    assert len(thinned(points, 1001)) == 1001 and len(thinned(points, 1000)) == 501


BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, *_):
        if name.split(".")[0] == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
sys.meta_path.insert(0, Blocked())
import importlib.util
importlib.util.find_spec = lambda name, found=importlib.util.find_spec: None if name == "torch" else found(name)
import numpy as np
from torchelev.ros2 import outputs, sensors
from torchelev.ros2.engine import SensorInput
from torchelev.ros2.engines import make_engine
from torchelev.ros2.settings import NodeSettings
engine = make_engine({"levels": {}}, NodeSettings(library=sys.argv[1]))
engine.update(SensorInput(np.zeros((9, 3), np.float32) - 1, np.eye(4), np.eye(4), 0.0))
outputs.grid_map(engine, ["elevation"]), outputs.costmap(engine, 0.5), outputs.map_cloud(engine, ["elevation"])
import torchelev.io.bags.point_cloud, torchelev.app.cli, torchelev.app.ros2_command, torchelev.frames.quaternions
assert "torch" not in sys.modules
print(int(np.isfinite(engine.layer("elevation")).sum()))
"""


def test_a_robot_needs_no_pytorch(library):
    command = [sys.executable, "-c", BLOCKED, library]
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout == "1\n"


@pytest.mark.parametrize("kind", ["torch", "library"])
@pytest.mark.parametrize("layout", ["isaaclab", "[1]", '{"pattern": 3}'])
def test_a_wrong_layout_is_refused(library, kind, layout):
    with pytest.raises(ValueError):
        engine_of(kind, library, height_scan=layout)


def test_an_engine_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match="no libtorchelev of this machine"):
        make_engine({}, NodeSettings(engine="library", library=str(tmp_path / "none.so")))
    with pytest.raises(ValueError, match="grid.resolution"):
        make_engine({"grid": {"resolution": -1.0}}, NodeSettings(engine="torch"))


def test_settings_of_the_map_are_the_default_config(library):
    engine = make_engine({}, NodeSettings(engine="library", library=library))
    assert engine.window().shape == (te.GridConfig().height, te.GridConfig().width)


def test_covariances_and_poses_of_links_reach_both(library):
    covariance = np.diag([0, 0, 0.01, 0, 0, 0]).astype(float)
    body = {"capsules": [{"link": "leg", "start": [0, 0, 0], "end": [0, 0, -0.4], "radius": 0.3}]}
    cfg = CFG | {"sensor": {"body": body}}
    links, found = np.eye(4)[None], []
    for kind in ("torch", "library"):
        engine = make_engine(cfg, NodeSettings(engine=kind, library=library))
        assert engine.links == ["leg"]
        walk(engine, 2, pose_covariance=covariance, T_base_links=links)
        found.append(engine)
    variances = [engine.layer("variance") for engine in found]
    assert np.array_equal(*variances, equal_nan=True) and np.nanmin(variances[0]) > 0.005
    assert found[0].statistics() == found[1].statistics()


@pytest.mark.parametrize("kind", ["torch", "library"])
def test_ground_points_and_cleared_cells(library, kind):
    engine = engine_of(kind, library)
    walk(engine, 1)
    center, known = np.array(engine.window().center), np.isfinite(engine.layer("elevation")).sum()
    engine.clear_around(center, 0.5)
    cleared = known - np.isfinite(engine.layer("elevation")).sum()
    assert 0 < cleared <= np.pi * 0.5**2 / 0.05**2 * 1.1
    feet = np.append(center, 0.3) + np.array([[0.2, 0.2, 0], [-0.2, 0.2, 0], [0, -0.2, 0]])
    engine.initialize(feet, "linear", np.eye(4))
    i, j = ((center - engine.window().corner) / 0.05).astype(int)
    assert engine.layer("elevation")[i, j] == pytest.approx(0.3, abs=1e-5)


def test_planes_paths_and_sites_need_pytorch(engines, tmp_path):
    torch, c = engines
    for ask in (
        c.planes,
        lambda: c.check_path(np.zeros((1, 3)), CORNERS, None),
        lambda: c.initialize_from(tmp_path, np.eye(4)),
    ):
        with pytest.raises(ValueError, match="needs PyTorch, and the node's engine is the C library"):
            ask()
    assert isinstance(torch.planes(), list)


CORNERS = np.array([[0.2, 0.1], [0.2, -0.1], [-0.2, -0.1], [-0.2, 0.1]])


def ground(heights):
    """An engine of PyTorch that knows these heights (H, W)."""
    engine = make_engine(CFG, NodeSettings(engine="torch"))
    known = torch_tensor(heights)[None]
    engine._map.state.elevation.copy_(known), engine._map.state.validity.fill_(True)
    engine._map.state.variance.fill_(1e-4)
    engine._map.initialize(torch_tensor(np.zeros((1, 1, 3))))  # rates it
    return engine


def torch_tensor(values):
    import torch

    return torch.as_tensor(values, dtype=torch.float32)


def test_paths_over_a_step_are_unsafe_from_there_on():
    heights = np.zeros((80, 60))
    heights[50:] = 0.5  # x > 0.5 m
    engine = ground(heights)
    path = np.array([[-1.0, 0, 0], [0.0, 0, 0.3], [1.0, 0, 0]])
    answer = engine.check_path(path, CORNERS, None)
    assert not answer.is_safe and answer.unsafe == [2] and "pose 2 cannot be reached safely" in answer.reason
    for safe in (path[:2], path[:1]):
        answer = engine.check_path(safe, CORNERS, None)
        assert answer.is_safe and answer.unsafe == [] and answer.reason == "every footprint along the path is safe"
    with pytest.raises(ValueError, match="path: must need at most 20000 footprints"):
        engine.check_path(path * 1e6, CORNERS, None)
    assert engine.check_path(path[:1], 5 * CORNERS, None).is_safe, "however wide"


def test_unknown_ground_is_safe_only_where_the_robot_stands():
    engine = make_engine(CFG, NodeSettings(engine="torch"))
    here, T = np.zeros((1, 3)), np.eye(4)
    assert engine.check_path(here, CORNERS, None).unsafe == [0]
    assert engine.check_path(here, CORNERS, T).is_safe
    T[:2, 3] = 1.0
    assert not engine.check_path(here, CORNERS, T).is_safe
    assert engine.check_path(here + [1, 1, 0], CORNERS, T).is_safe


@pytest.mark.parametrize("kind", ["torch", "library"])
def test_the_first_ground_is_where_the_robot_is(library, kind):
    engine = engine_of(kind, library)
    T = np.eye(4)
    T[:2, 3] = 30.0, -20.0
    feet = np.array([[0.2, 0.2, 0.1], [-0.2, 0.2, 0.1], [0, -0.2, 0.1]]) + [30, -20, 0]
    engine.initialize(feet, "linear", T)
    np.testing.assert_allclose(engine.window().center, (30, -20), atol=0.05)
    heights = engine.layer("elevation")
    assert np.isfinite(heights).sum() > 20 and np.nanmax(abs(heights - 0.1)) < 1e-4


def test_outlines_of_a_table_and_its_floor():
    heights = np.zeros((80, 60))
    heights[30:50, 20:40] = 0.4
    outlines = outputs.make_outlines(ground(heights).planes())
    assert [one.kind for one in outlines if one.kind != "inset"] == ["boundary", "hole", "boundary"]
    table = outlines[-1].corners
    assert table[:, 2] == pytest.approx(0.4, abs=1e-3)
    assert (abs(table[:, 0]) < 0.48).all() and abs(table[:, 0]).max() > 0.4


def test_a_part_of_the_map(engines):
    window = engines[1].window()
    x, y = window.corner[0] + 1.0, window.corner[1] + 0.5
    grid = outputs.grid_map(engines[1], ["elevation"], outputs.area_of((x, y), (0.5, 0.4), 0.05))
    part = from_grid_map(grid)
    assert part.layers["elevation"].shape == (10, 8)
    np.testing.assert_allclose(part.center[:2], (x, y), atol=1e-6)
    whole = engines[1].layer("elevation")
    assert np.array_equal(part.layers["elevation"], whole[15:25, 6:14], equal_nan=True)
    edge = from_grid_map(outputs.grid_map(engines[1], ["elevation"], outputs.area_of(window.corner, (1, 1), 0.05)))
    assert edge.layers["elevation"].shape == (10, 10)
    with pytest.raises(ValueError, match="has no cells around"):
        outputs.grid_map(engines[1], ["elevation"], outputs.area_of((x + 50, y), (1, 1), 0.05))


def test_a_body_as_solids():
    capsule = {"link": "leg", "start": [0, 0, 0], "end": [0.3, 0, 0.4], "radius": 0.1}
    box = {"link": "trunk", "center": [0.1, 0, 0], "half_lengths": [0.3, 0.2, 0.1]}
    trunk, cylinder, *balls = outputs.make_solids({"capsules": [capsule], "boxes": [box]}, "base")
    assert (trunk.link, trunk.kind, trunk.size) == ("trunk", "box", (0.6, 0.4, 0.2))
    assert [one.kind for one in balls] == ["sphere", "sphere"] and balls[1].position.tolist() == [0.3, 0, 0.4]
    assert cylinder.size == pytest.approx((0.2, 0.2, 0.5))
    np.testing.assert_allclose(to_rotation(cylinder.quat_wxyz)[:, 2], [0.6, 0, 0.8], atol=1e-12)
    (only,) = outputs.make_solids({"lower": [-0.4, -0.2, 0], "upper": [0.4, 0.2, 0.2]}, "base")
    assert only.link == "base" and only.position == pytest.approx([0, 0, 0.1]) and only.size == (0.8, 0.4, 0.2)
    assert outputs.make_solids(None, "base") == []
    default = te.BodyConfig()
    for body in ({}, {"lower": list(default.lower)}):
        (box,) = outputs.make_solids(body, "base")
        assert box.size == pytest.approx(np.subtract(default.upper, default.lower))
    down = outputs.make_solids({"capsules": [capsule | {"end": [0, 0, -1]}]}, "base")[0]
    np.testing.assert_allclose(to_rotation(down.quat_wxyz)[:, 2], [0, 0, -1], atol=1e-12)
