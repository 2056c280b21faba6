"""Both engines of a node: the same map, files and sentences; and what is published of it."""

import subprocess
import sys

import numpy as np
import pytest

import torchelev as te
from tests.runtime.test_maps import instants
from torchelev.io.grid_map import from_grid_map, to_grid_map
from torchelev.io.occupancy import to_occupancy_grid
from torchelev.ros2 import outputs
from torchelev.ros2.engine import thinned
from torchelev.ros2.engines import make_engine
from torchelev.ros2.settings import NodeSettings
from torchelev.runtime.library import build_library

CFG = {"grid": {"resolution": 0.05, "length_x": 4.0, "length_y": 3.0}, "drift": None}
LAYERS = ("elevation", "variance", "traversability", "upper_bound")


@pytest.fixture(scope="module")
def library():
    return build_library()._name


def engine_of(kind, library, **settings):
    return make_engine(CFG, NodeSettings(engine=kind, library=library, **settings))


def walk(engine, num=4):
    for points, T_map_sensor, T_map_base, dt in instants(1, num):
        engine.update(points[0].numpy(), T_map_sensor[0].numpy(), T_map_base.numpy(), dt)
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
    assert torch.diagnose() == c.diagnose()


@pytest.mark.parametrize("k", [0, 1], ids=["torch", "library"])
def test_unknown_layers_are_refused(engines, k):
    with pytest.raises(ValueError, match="elevaton"):
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
from torchelev.ros2 import outputs
from torchelev.ros2.engines import make_engine
from torchelev.ros2.settings import NodeSettings
engine = make_engine({}, NodeSettings(library=sys.argv[1]))
engine.update(np.zeros((9, 3), np.float32) - 1, np.eye(4), np.eye(4), 0.0)
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
