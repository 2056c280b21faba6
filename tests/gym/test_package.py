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


MODULES = {  # the library that each may import, beside those before it
    "torchelev": [],
    "torchelev.sim": [],
    "torchelev.planes": [],
    "torchelev.filters": [],
    "torchelev.encoders": [],
    "torchelev.gym": ["gymnasium"],
}
WITHOUT = [  # module, missing library, extra that has it
    ("torchelev.gym", "gymnasium", "gym"),
    ("torchelev.gym.feed", "gymnasium", "gym"),
    ("torchelev.gym.wrappers", "gymnasium", "gym"),
    ("torchelev.gym.rsl_rl", "gymnasium", "gym"),
    ("torchelev.gym.rsl_rl", "rsl_rl", "rl"),
    ("torchelev.gym.rsl_rl", "tensordict", "rl"),
    ("torchelev.encoders.rsl_rl", "rsl_rl", "rl"),
    ("torchelev.encoders.rsl_rl", "tensordict", "rl"),
]


@pytest.mark.slow(1)
def test_modules_import_no_reinforcement_learning():
    """Of rsl-rl nothing, and gymnasium only with `torchelev.gym`; one after the other in one process."""
    loaded = f"print([name for name in {LIBRARIES} if name in sys.modules])"
    done = run("\n".join(f"import {module}\n{loaded}" for module in MODULES))
    assert done.stdout.splitlines() == [str(libraries) for libraries in MODULES.values()], done.stderr


@pytest.mark.slow(1)
def test_imports_without_their_library_name_the_extra():
    code = f"""
import importlib, torchelev.elevation_map, torchelev.observations  # operators are registered once
for module, missing, extra in {WITHOUT}:
    kept = dict(sys.modules)
    sys.modules[missing] = None
    try:
        importlib.import_module(module)
    except ImportError as error:
        assert str(error).endswith(f"install it with pip install 'torchelev[{{extra}}]'"), error
    else:
        raise AssertionError(f"{{module}} needs no {{missing}}")
    for name in set(sys.modules) - set(kept) | {{missing}}:  # what the attempt left
        if name.split(".")[0] in ("torchelev", missing):
            sys.modules.pop(name, None)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


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
