"""The library as CMake builds and installs it: the examples, and what updates allocate."""

import dataclasses
import io
import shutil
import subprocess

import numpy as np
import pytest

import torchelev as te
from tests.levels.walks import line, look, make_map
from tests.runtime.test_maps import instants, numpy
from torchelev.filters.chain import FilterConfig
from torchelev.kernels.registry import PACKAGE
from torchelev.runtime.library import CMap, build_library, open_library
from torchelev.runtime.stream import write_instant
from torchelev.sim.exact import covered_scenes

RUNTIME = PACKAGE / "runtime"
pytestmark = [pytest.mark.slow(30), pytest.mark.skipif(not shutil.which("cmake"), reason="needs CMake")]


def run(*command, **options):
    return subprocess.run([str(part) for part in command], check=True, capture_output=True, timeout=300, **options)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Where the library was installed, and the examples that were built against it."""
    folder = tmp_path_factory.mktemp("cmake")
    run("cmake", "-S", RUNTIME, "-B", folder / "build", f"-DCMAKE_INSTALL_PREFIX={folder / 'installed'}")
    run("cmake", "--build", folder / "build", "--parallel")
    run("cmake", "--install", folder / "build")
    run("cmake", "-S", RUNTIME / "examples", "-B", folder / "ex", f"-DCMAKE_PREFIX_PATH={folder / 'installed'}")
    run("cmake", "--build", folder / "ex", "--parallel")
    return folder / "installed", folder / "ex"


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "map.json"
    te.ElevationMapConfig().save(path)
    return path


def stream(sensors, num=8):
    file = io.BytesIO()
    for points, T_map_sensor, T_map_base, dt in instants(sensors, num):
        T_map_base = T_map_sensor[0] if T_map_base is None else T_map_base
        write_instant(file, *numpy(points, T_map_sensor, T_map_base), dt)
    return file.getvalue()


def test_the_example_maps_a_step(installed, config):
    lines = run(installed[1] / "torchelev_step", config).stdout.decode().splitlines()
    heights = np.array([line.split() for line in lines[:11]], float)
    assert np.allclose(heights[:, :12], 0.0, atol=0.02) and np.allclose(heights[:, 14:], -0.15, atol=0.02)


def test_the_loop_reads_what_python_reads(installed, config):
    done = run(installed[1] / "torchelev_loop", config, "isaac_lab", 2, input=stream(2))
    scans = np.frombuffer(done.stdout, np.float32).reshape(-1, 187)
    for library in (open_library(next(installed[0].rglob("libtorchelev.so"))), build_library()):
        emap = CMap(library, config)
        scan = emap.scan("isaac_lab")
        for found, (points, T_map_sensor, T_map_base, dt) in zip(scans, instants(2, 8), strict=True):
            T_map_base = T_map_sensor[0] if T_map_base is None else T_map_base
            emap.update(*numpy(points, T_map_sensor, T_map_base), dt)
            assert np.array_equal(found, scan(T_map_base.numpy())[0])
    assert "8 updates: p50" in done.stderr.decode()


def test_the_loop_names_what_is_wrong(installed, config, tmp_path):
    for arguments, words in [
        ((), "usage:"),
        ((tmp_path / "none.json", "mjlab"), "none.json: cannot be read (No such file or directory)"),
        ((config, "mjlab"), "stream: empty"),
        ((config, "mjlabs"), "layout: must be one of isaac_lab, mjlab, legged_gym"),
    ]:
        done = subprocess.run([installed[1] / "torchelev_loop", *map(str, arguments)], input=b"", capture_output=True)
        assert done.returncode != 0 and words in done.stderr.decode()


GATED = te.ElevationMapConfig(sensor=te.SensorConfig(max_distance=1.5, body=te.BodyConfig()))
PLACES = [*line((0.0, -2.0, 0.0), (0.0, 1.0, 0.0), 6), *((x, 0.0, 12 * covered_scenes.RISE) for x in (0.0, 0.4))]
FAR = te.ElevationMapConfig(grid=te.GridConfig(length_x=4, length_y=3), raycast=te.RaycastConfig(max_range=30.0))


@pytest.mark.parametrize(
    "cfg, max_points, threads",
    [*((te.ElevationMapConfig(), n, t) for n, t in [(10_000, 1), (10_000, 2), (100_000, 2)])]
    + [(GATED, 10_000, 2), (FAR, 10_000, 1)],
)
def test_nothing_is_allocated_after_creation(installed, tmp_path, cfg, max_points, threads):
    instants = stream(1) + stream(3) + stream(2)
    assert count_allocations(installed, tmp_path, cfg, max_points, threads, instants) == "none\n"


@pytest.mark.parametrize("threads", [1, 2])
def test_surfaces_that_were_met_before_allocate_nothing(installed, tmp_path, threads):
    file, cfg = io.BytesIO(), make_map().cfg
    for place in PLACES:
        points, T_map_sensor, T_map_base = look(covered_scenes.bridge(), *place)
        write_instant(file, *numpy(points, T_map_sensor, T_map_base[0]), 0.2)
    found = count_allocations(installed, tmp_path, cfg, 20_000, threads, 2 * file.getvalue(), len(PLACES))
    assert found == "none\n"


def test_maps_with_levels_allocate_nothing_wherever_the_sensors_are(installed, tmp_path):
    file, cfg, rng = io.BytesIO(), te.ElevationMapConfig(levels=te.LevelsConfig()), np.random.default_rng(0)
    for x, num_sensors in ((0.1, 1), (0.3, 2), (1.0, 1), (4.0, 2)):
        T = np.eye(4)[None].repeat(num_sensors, 0)
        T[:, :3, 3] = x, 0.0, 0.5
        points = np.dstack([rng.uniform(-2, 2, (num_sensors, 2000, 2)), np.full((num_sensors, 2000), -0.5)])
        write_instant(file, points.astype(np.float32), T, np.eye(4), 0.2)
    assert count_allocations(installed, tmp_path, cfg, 10_000, 1, file.getvalue()) == "none\n"


def count_allocations(installed, tmp_path, cfg, max_points, threads, instants, free_instants=0):
    """Return what allocations.cpp prints; the first instants may allocate, and are forgotten."""
    config = tmp_path / "map.json"
    dataclasses.replace(cfg, filters=(FilterConfig(layer="smooth", filter="gaussian"),)).save(config)
    library = next(installed[0].rglob("libtorchelev.a"))
    program = tmp_path / "allocations"
    source = PACKAGE.parent / "tests" / "runtime" / "allocations.cpp"
    run(
        "c++",
        "-std=c++17",
        f"-I{installed[0] / 'include'}",
        source,
        library,
        *"-pthread -Wl,--wrap=calloc -o".split(),
        program,
    )
    arguments = (config, max_points, threads, free_instants)
    return subprocess.run([program, *map(str, arguments)], input=instants, capture_output=True).stdout.decode()


def test_another_file_is_no_library():
    with pytest.raises(ValueError, match="no libtorchelev of this machine"):
        open_library(RUNTIME / "CMakeLists.txt")
