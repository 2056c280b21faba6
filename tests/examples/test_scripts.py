"""Every example runs as a user would run it, prints what it promises, and has its picture on the page."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import Forks

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
#: those of a simulator, which `make test-mjlab` and the like run in it
SIMULATORS = {
    "genesis_maps": ("genesis", "Genesis"),
    "isaac_lab_term": ("isaaclab", "Isaac Lab"),
    "mjlab_term": ("mjlab", "mjlab"),
    "newton_maps": ("newton", "Newton"),
}
LAUNCH = {"fleet_torchrun": "-m torch.distributed.run --standalone --nproc-per-node 2"}
QUICK = {
    "fleet_torchrun": "--steps 11",
    "ground_classes": "--steps 6",
    "gymnasium_observation": "--steps 5",
    "live_view": "--num-envs 4 --steps 5",
    "many_robots": "--num-envs 8 --steps 3",
    "mujoco_depth_camera": "--steps 30",
    "own_head": "--batches 1 --steps 2",
    "plan_around_water": "--quick",
    "under_a_table": "--quick",
    "planning": "--quick",
    "robot_50hz": "--seconds 1 --eager",
    "world_map": "--steps 20",
}


def run(name, folder, **environment):
    """Run an example in an empty folder; return what it prints, and its picture."""
    script = [ROOT / "examples" / f"{name}.py", *QUICK[name].split(), "--picture", "picture.png"]
    command = [sys.executable, *LAUNCH.get(name, "").split(), *script]
    env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    result = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout, (folder / "picture.png").read_bytes()


def numbers(text):
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


def check_fleet(out):
    for line in (line for line in out.splitlines() if "drifted" in line):
        _, *offsets = numbers(line)
        assert len(offsets) == 4 and all(abs(a - b) < 10 for a, b in zip(offsets[:2], offsets[2:], strict=True)), line
    assert out.count("the site of 4 robots has 4 tiles") == 2


def check_classes(out):
    cells, share = numbers(out)
    assert cells > 2000 and share > 90


def check_mujoco(out):
    height, true_height, known = numbers(out.splitlines()[-2])
    assert abs(height - true_height) < 0.02 and known > 500
    assert "nothing wrong" in out


def check_planning(out):
    narrow, wide = out.splitlines()
    assert narrow.startswith("as a point") and "cannot be reached safely" in narrow
    assert wide.startswith("as wide as the robot") and "every footprint along the path is safe" in wide


def check_around_water(out):
    heights, classes = (numbers(line) for line in out.splitlines())  # length, and metres of grass, mud and water
    assert heights[3] > 1.5 and classes[3] == 0 and 0.5 < classes[2] < 1.6 and classes[0] > heights[0] + 0.5


def check_own_head(out):
    from training.traversability.train import main

    command = next(line for line in out.splitlines() if "python -m training.traversability" in line)
    given = main.make_context("training", shlex.split(command)[3:]).params
    assert (given["robot"].length, given["robot"].step_height) == (1.2, 0.3)


def check_world_map(out):
    lines = out.splitlines()
    errors, offsets = zip(*(numbers(line)[1:] for line in lines[:4]), strict=True)
    assert max(errors) - min(errors) > 10 and max(abs(a - b) for a, b in zip(errors, offsets, strict=True)) < 1
    without, aligned = (numbers(line)[-1] for line in lines[4:6])
    assert aligned < without / 3
    assert lines[6].startswith("a robot that starts knows") and numbers(lines[6])[0] > 90


CHECKS = {
    "fleet_torchrun": check_fleet,
    "ground_classes": check_classes,
    "gymnasium_observation": lambda out: "'map': (2, 16, 10)" in out,
    "live_view": lambda out: "the live view is at http://localhost" in out and " pictures in 5 steps" in out,
    "many_robots": lambda out: bool(re.search(r"8 robots, 768 points each(.|\n)* robots per second", out)),
    "mujoco_depth_camera": check_mujoco,
    "own_head": check_own_head,
    "plan_around_water": check_around_water,
    "planning": check_planning,
    "under_a_table": lambda out: "0.5 m fits" in out and "0.9 m does not fit" in out,
    "world_map": check_world_map,
    "robot_50hz": lambda out: 0 < numbers(out)[0] <= 51 and "p99" in out,
}


@pytest.fixture(scope="module")
def forks():
    """A process that has imported what the examples import."""
    forks = Forks("torchelev", "gymnasium", "torchelev.viz.plot")  # not MuJoCo, which starts to render once
    yield forks
    forks.close()


@pytest.mark.slow(3)
@pytest.mark.parametrize("name", [name for name in SCRIPTS if name not in {*LAUNCH, *SIMULATORS}])
def test_runs(name, tmp_path, forks):
    script = ROOT / "examples" / f"{name}.py"
    code, out, err = forks.run(tmp_path, script, *QUICK[name].split(), "--picture", "picture.png")
    if name == "ground_classes" and code and ("EGL" in err or "OpenGL" in err):
        pytest.skip("OpenGL cannot be had here")
    assert code == 0, out + err
    assert CHECKS[name](out) is not False, out
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow(8)
@pytest.mark.parametrize("name", LAUNCH)
def test_runs_in_processes(name, tmp_path):
    out, picture = run(name, tmp_path)
    assert CHECKS[name](out) is not False, out
    assert picture.startswith(b"\x89PNG")


@pytest.mark.slow(8)
def test_mujoco_casts_rays_where_it_cannot_render(tmp_path):
    out, _ = run("mujoco_depth_camera", tmp_path, MUJOCO_GL="disable")
    assert "casting rays in place of rendering" in out
    check_mujoco(out)


@pytest.mark.parametrize("name", SCRIPTS)
def test_is_short_and_on_the_page(name):
    assert len((ROOT / f"examples/{name}.py").read_text().splitlines()) <= 80
    page = (ROOT / "docs/examples.md").read_text()
    assert f"](pictures/example_{name}.png)" in page and f"../examples/{name}.py" in page
    picture = ROOT / f"docs/pictures/example_{name}.png"
    assert picture.stat().st_size < 200_000


@pytest.mark.slow(3)
@pytest.mark.parametrize("name", SIMULATORS)
def test_says_which_simulator_it_needs(name):
    module, title = SIMULATORS[name]
    assert importlib.util.find_spec(module) is None, f"run it in {title}: its own target does"
    command = [sys.executable, ROOT / "examples" / f"{name}.py"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert (
        done.returncode == 2 and done.stderr.startswith(f"This example needs {title}") and "make test-" in done.stderr
    )
