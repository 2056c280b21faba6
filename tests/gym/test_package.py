"""What `import torchelev` and `torchelev.gym` need, and the extras that hold it."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIBRARIES = ("gymnasium", "rsl_rl", "tensordict")


def run(code):
    """Run code in a new process, in which the imports of `missing` fail."""
    command = [sys.executable, "-c", f"import sys\n{code}"]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


def without(*names):
    return "".join(f"sys.modules[{name!r}] = None\n" for name in names)


@pytest.mark.slow(1)
@pytest.mark.parametrize(
    "module", ["torchelev", "torchelev.sim", "torchelev.planes", "torchelev.filters", "torchelev.encoders"]
)
def test_the_package_imports_no_reinforcement_learning(module):
    done = run(f"import {module}\nprint([name for name in {LIBRARIES} if name in sys.modules])")
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.slow(1)
def test_torchelev_gym_imports_no_rsl_rl():
    done = run(f"import torchelev.gym\nprint([name for name in {LIBRARIES} if name in sys.modules])")
    assert done.stdout.strip() == "['gymnasium']", done.stderr


@pytest.mark.slow(1)
@pytest.mark.parametrize(
    "module, missing, extra",
    [
        ("torchelev.gym", "gymnasium", "gym"),
        ("torchelev.gym.feed", "gymnasium", "gym"),
        ("torchelev.gym.wrappers", "gymnasium", "gym"),
        ("torchelev.gym.rsl_rl", "gymnasium", "gym"),
        ("torchelev.gym.rsl_rl", "rsl_rl", "rl"),
        ("torchelev.gym.rsl_rl", "tensordict", "rl"),
        ("torchelev.encoders.rsl_rl", "rsl_rl", "rl"),
        ("torchelev.encoders.rsl_rl", "tensordict", "rl"),
    ],
)
def test_an_import_without_its_library_names_the_extra(module, missing, extra):
    done = run(f"import torchelev\n{without(missing)}import {module}")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(f"install it with pip install 'torchelev[{extra}]'"), done.stderr


def test_environments_can_be_imported_without_gymnasium():
    done = run(f"{without('gymnasium')}import envs")
    assert done.returncode == 0, done.stderr


def test_extras_hold_what_is_imported():
    tomllib = pytest.importorskip("tomllib")  # of Python 3.11
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    assert any(one.startswith("gymnasium") for one in extras["gym"])
    assert "torchelev[gym]" in extras["rl"] and any(one.startswith("rsl-rl-lib") for one in extras["rl"])
    assert not any(one.startswith(("gymnasium", "rsl")) for one in project["dependencies"])
