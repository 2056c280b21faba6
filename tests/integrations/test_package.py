"""The terms import no simulator, and `import torchelev` imports no terms."""

import pytest

from tests.processes import run_python

SIMULATORS = ("mjlab", "isaaclab", "mujoco", "warp", "gymnasium", "rsl_rl")


@pytest.mark.slow(1)
@pytest.mark.parametrize("module", ["torchelev.integrations.mjlab", "torchelev.integrations.isaac_lab"])
def test_the_terms_import_no_simulator(module):
    done = run_python(f"import sys, {module}\nprint([name for name in {SIMULATORS} if name in sys.modules])")
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.slow(1)
def test_the_library_imports_no_terms():
    done = run_python("import sys, torchelev\nprint([name for name in sys.modules if 'integrations' in name])")
    assert done.stdout.strip() == "[]", done.stderr
