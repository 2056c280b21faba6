"""`torchelev bag` proposes what a bag leaves open, and its command gives the map of the complete bag as printed."""

import shlex

import numpy as np
import pytest

from tests.io.bags.poses.test_placing import Shape, write
from torchelev.io.export import load_npz

SHAPES = {
    "/tf": (Shape(), "--map-frame odom --base-frame base_link"),
    "namespace": (Shape(space="/robot1"), "--map-frame odom --base-frame base_link"),
    "odometry alone": (Shape(tf=False, odometry="base_link"), "--poses /odom"),
    "odometry without child": (Shape(tf=False, odometry=""), "--poses /odom"),
    "clock ahead": (Shape(ahead=37.0), "--clock-offset /lidar/points=-37.0"),
    "clock since power-on": (Shape(ahead=-1_699_999_000.0), "--clock-offset /lidar/points=1699999000."),
    "no stamps": (Shape(stamped=False), "--stamps recorded"),
    "registered clouds": (Shape(registered=True), "--rays-from base_link"),
    "upside down": (Shape(inverted=True), "--map-frame odom --base-frame base_link"),
}


def propose(run, path):
    code, out, err = run("bag", path)
    assert (code, err) == (0, "") and "\nto map it\n" in out
    return shlex.split(out.split("\nto map it\n")[1].splitlines()[0])


@pytest.mark.slow(6)
@pytest.mark.parametrize("name", SHAPES)
def test_the_proposed_command_gives_the_map(run, tmp_path, name):
    shape, words = SHAPES[name]
    command = propose(run, write(tmp_path / "drive", shape))
    assert command[:2] == ["torchelev", "map"] and words in " ".join(command)
    code, _, err = run(*command[1:], "--size", 4, "--resolution", 0.1, "--fixed")
    assert (code, err) == (0, "")
    saved = load_npz(tmp_path / "map.npz")
    elevation = saved.layers["elevation"]
    x, y = [saved.center[k] + (np.arange(40) + 0.5 - 20) * 0.1 for k in (0, 1)]
    near = np.abs(y) < 0.6
    for low, high, z in ((0.5, 0.9, 0.0), (1.1, 1.25, 0.1), (1.4, 1.55, 0.2)):
        found = elevation[(x > low) & (x < high)][:, near]
        found = found[np.isfinite(found)]
        assert len(found) > 5 and abs(np.median(found) - z) < 0.01


@pytest.mark.slow(1)
def test_what_cannot_be_proposed_names_the_option(run, tmp_path):
    _, out, _ = run("bag", write(tmp_path / "drive", Shape(odometry="base_link", tf=False, mount=False)))
    assert "give --poses /odom, and --extrinsics with the pose of lidar on the base" in out


@pytest.mark.slow(1)
def test_a_jump_is_named_by_both_commands_before_the_map(run, tmp_path):
    path = write(tmp_path / "drive", Shape(jump=3.0))
    assert "warning: base_link jumps by 3.0 m in odom" in run("bag", path)[1]
    code, _, err = run("map", path, "--size", 2)
    assert code == 0 and err.count("base_link jumps by 3.0 m in odom") == 1


REFUSED = {
    "offset": (("--clock-offset", "/x=soon"), "--clock-offset /x=soon: must be a number of seconds, or TOPIC=SECONDS"),
    "offset of no topic": (
        ("--clock-offset", "/x=1"),
        "--clock-offset /x: is no topic of scans; these are /lidar/points",
    ),
    "rays": (("--rays-from", "mast"), "the transforms have no frame mast; frames are base_link, lidar, odom"),
    "rays of raw clouds": (("--rays-from", "base_link"), "--rays-from base_link: no cloud is in the map's frame"),
    "nothing left": (("--start", "100"), "no messages on /lidar/points after --start 100"),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", REFUSED)
def test_wrong_options_are_refused(run, tmp_path, name):
    options, words = REFUSED[name]
    code, _, err = run("map", write(tmp_path / "drive", Shape()), *options)
    assert code == 2 and words in err and len(err.splitlines()) == 1


@pytest.mark.slow(2)
def test_the_mounting_can_be_given(run, tmp_path):
    path = write(tmp_path / "drive", Shape(mount=False))
    code, out, err = run("map", path, "--size", 2, "--extrinsics", "1 0 0 0.1  0 1 0 0  0 0 1 0.4")
    assert (code, err) == (0, "") and "in odom, around base_link" in out and "overlap" not in out


def test_the_page_takes_the_same_options(run):
    pages = [run(command, "--help")[1] for command in ("map", "view")]
    for option in ("--tf", "--extrinsics", "--rays-from", "--clock-offset", "--stamps", "--start", "--end"):
        assert all(option in page for page in pages)


def test_options_of_bags_are_refused_for_folders(run, recording):
    code, _, err = run("map", recording, "--tf", "/tf", "--stamps", "recorded", "--start", 1)
    assert code == 2 and "--tf, --stamps, --start: for bags only" in err
