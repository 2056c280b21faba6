"""Commands, options and help texts."""

import re
import subprocess
import sys

import pytest

from torchelev.filters import FILTERS


def test_filters_are_listed(run):
    code, out, _ = run("filters")
    assert code == 0 and "gaussian(layer)  sigma=0.1\n    Return the Gaussian mean" in out
    assert [line.split("(")[0] for line in out.splitlines()[::2]] == sorted(FILTERS)


def test_help_tells_a_newcomer_what_to_give(run):
    code, out, _ = run("map", "--help")
    assert code == 0
    for word in ("Example", "poses.txt", "KITTI", "TUM", "--intrinsics", "PREFIX.npz", "z axis points up"):
        assert word in " ".join(out.split())
    assert max(map(len, out.splitlines())) <= 80


def options_by_group(text):
    """Return the options below each title of a help text."""
    groups, title = {}, ""
    for line in text.splitlines():
        title = line[:-1] if line[:1].strip() and line.endswith(":") else title
        groups.setdefault(title, []).extend(re.findall(r"^  (?:-h, )?--([\w-]+)", line))
    return groups


@pytest.mark.parametrize(("command", "others"), [("map", ["out", "grid-map", "video", "every"]), ("view", ["host"])])
def test_options_are_listed_by_group(run, command, others):
    groups = options_by_group(run(command, "--help")[1])
    assert groups["Recording"] == ["poses", "extrinsics", "depth-scale", "depth-axes", "colour"]
    assert groups["Map"] == ["resolution", "size", "fixed", "levels", "device", "config"]
    assert {"intrinsics", "dt"} <= set(groups["Folders of files"])
    assert {"points", "tf"} <= set(groups["Bags"])
    assert set(others) <= set(groups["Output" if command == "map" else "Page"])
    assert groups["Other options"] == ["help"]


@pytest.mark.parametrize("command", ["map", "demo", "fleet", "filters"])
def test_every_command_is_listed_with_a_whole_sentence(run, command):
    line = next(line for line in run("--help")[1].splitlines() if line.split()[:1] == [command])
    assert line.endswith(".") and not line.endswith("...")


@pytest.mark.slow(2)
def test_demo_prints_what_it_measured(run, tmp_path):
    code, out, err = run("demo", "--out", "picture.png", "--seconds", 0.1)
    assert code == 0 and out.startswith("RMSE ") and out.endswith("\nwrote picture.png\n") and "100%" in err
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    code, out, err = run("demo", "--seconds", 0.1, "--quiet")
    assert (code, err) == (0, "") and out.endswith("\nwrote demo.png\n") and (tmp_path / "demo.png").exists()


@pytest.mark.slow(1)
def test_runs_as_a_module():
    result = subprocess.run([sys.executable, "-m", "torchelev", "--help"], capture_output=True, text=True, check=True)
    assert "map" in result.stdout and "demo" in result.stdout
