"""`torchelev bag` and `torchelev map`: options of depth images, and topics that cannot be read."""

import numpy as np
import pytest

from tests.io.bags.files.rewriting import rewrite
from tests.io.bags.files.test_mixed_mcap import JSON
from tests.io.bags.synthetic import write_drive
from tests.io.bags.test_cameras import DEPTH, write
from torchelev.io.export import load_npz


@pytest.mark.slow(1)
def test_options_of_depth_images_are_used(run, tmp_path):
    path = write(tmp_path, info="/calibration/left", unit=1e-4)
    options = ("--depth", DEPTH, "--camera-info", "/calibration/left", "--depth-scale", 1e-4, "--size", 6)
    code, _, err = run("map", path, *options)
    assert (code, err) == (0, "")
    elevation = load_npz(tmp_path / "map.npz").layers["elevation"]
    assert -0.02 < np.nanmin(elevation) and 0.38 < np.nanmax(elevation) < 0.42  # four steps of 0.1 m
    code, _, err = run("map", path, *options, "--depth-axes", "sideways")
    assert code == 2 and "'optical', 'forward', 'opengl'" in err


def test_options_of_depth_images_are_only_for_bags(run, recording):
    code, _, err = run("map", recording, "--depth-scale", 0.001, "--depth-axes", "forward")
    assert code == 2 and "--depth-scale: is for depth images only" in err


@pytest.mark.slow(1)
@pytest.mark.parametrize("command", ["bag", "map"])
def test_topics_that_are_not_read_are_listed_with_their_encoding(run, tmp_path, command):
    source = next(write_drive(tmp_path, depth=False).glob("*.mcap"))
    path = rewrite(source, tmp_path / "mixed.mcap", "", (JSON,))
    code, out, err = run(command, path, *(("--size", 2) if command == "map" else ()))
    assert (code, err) == (0, "")
    expected = {
        "bag": "/markers foxglove.SceneUpdate 3 not read: encoded as json",
        "map": "not read /markers (3 of foxglove.SceneUpdate: encoded as json)",
    }
    assert expected[command] in " ".join(out.split())
