"""The package: what its wheel holds, what it asks of pip, and that it runs without the checkout."""

import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Nothing of the checkout may be found by accident.
OUTSIDE = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
EXTRA = re.compile(r"(?:torchelev|['\" ]\.)\[([a-z]+(?:,[a-z]+)*)\]")


def execute(*command, **options):
    """Run a command and return what it prints; an error holds that too."""
    result = subprocess.run([str(c) for c in command], capture_output=True, text=True, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def pip_in(bin_folder):
    """The command with which this environment's pip installs into another one, without a network."""
    return sys.executable, "-m", "pip", "--python", bin_folder / "python", "install", "--no-index"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built without a network: hatchling comes with the extra `dev`."""
    folder = tmp_path_factory.mktemp("wheel")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--wheel-dir", folder]
    execute(sys.executable, "-m", "pip", "wheel", ROOT, *options)
    return next(folder.glob("torchelev-*.whl"))


@pytest.fixture(scope="module")
def metadata(wheel):
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(archive.read(name).decode())


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder of a fresh environment's programs, which sees the packages of this one, but no checkout."""
    folder = tmp_path_factory.mktemp("fresh")
    execute(sys.executable, "-m", "venv", "--without-pip", folder)
    bin_folder = folder / "bin"
    site = Path(execute(bin_folder / "python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (site / "packages.pth").write_text(sysconfig.get_path("purelib"))
    # The checkout's own installation is visible there too: ignore it, and uninstall nothing.
    execute(*pip_in(bin_folder), "--no-deps", "--ignore-installed", wheel, env=OUTSIDE)
    return bin_folder


@pytest.mark.slow(3)
def test_the_wheel_holds_the_library_alone(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"torchelev"}
    sources = {str(path.relative_to(ROOT)) for path in (ROOT / "torchelev").rglob("*.py")}
    assert sources <= set(names)
    assert "torchelev/py.typed" in names and any(name.endswith(".pt") for name in names)


@pytest.mark.slow(3)
def test_pip_keeps_the_torch_that_is_there(metadata):
    core = [line for line in metadata.get_all("Requires-Dist") if "extra ==" not in line]
    assert len(core) == 2
    for line in core:
        assert re.fullmatch(r"(torch|numpy)>=[\d.]+", line), f"{line}: an upper bound or a pin makes pip replace it"


@pytest.mark.slow(3)
def test_says_who_it_is_for(metadata):
    assert "Typing :: Typed" in metadata.get_all("Classifier")
    assert metadata.get_all("Project-URL")
    versions = {line.rsplit(" ", 1)[1] for line in metadata.get_all("Classifier") if "Python :: 3." in line}
    assert f"3.{sys.version_info.minor}" in versions


@pytest.mark.slow(3)
def test_every_extra_that_is_named_exists(metadata):
    files = [*ROOT.glob("*.md"), ROOT / "Makefile", *ROOT.glob("notebooks/*.ipynb")]
    for folder, ending in (("torchelev", "py"), ("envs", "py"), ("training", "py"), ("examples", "py"), ("docs", "md")):
        files += (ROOT / folder).rglob(f"*.{ending}")
    named = {extra for file in files for names in EXTRA.findall(file.read_text()) for extra in names.split(",")}
    assert {"io", "gym", "rl"} <= named <= set(metadata.get_all("Provides-Extra"))


@pytest.mark.slow(15)
def test_runs_without_the_checkout(installed, tmp_path):
    def run(program, *arguments):
        return execute(installed / program, *arguments, cwd=tmp_path, env=OUTSIDE)

    path = Path(run("python", "-c", "import torchelev; print(torchelev.__file__)").strip())
    assert path.is_relative_to(installed.parent)
    assert run("torchelev", "demo", "--seconds", 1, "--quiet").startswith("RMSE ")
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert run("torchelev", "--help").startswith("Usage: torchelev ")
    assert run("python", "-m", "torchelev", "--help").startswith("Usage: python -m torchelev ")


@pytest.mark.slow(3)
def test_pip_needs_nothing_where_torch_and_numpy_are(installed, wheel):
    planned = execute(*pip_in(installed), "--dry-run", wheel, env=OUTSIDE)
    assert "Requirement already satisfied: torch>=" in planned and "Would install" not in planned
