"""`torchelev view`, from end to end."""

import os
import signal
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest

from tests.helpers import mapped
from tests.io.bags.synthetic import write_drive
from torchelev.io import export

viser = pytest.importorskip("viser", reason="needs torchelev[view]")


@pytest.mark.slow(2)
def test_a_folder_shows_the_map_that_map_writes(run, recording, port, shown, tmp_path):
    options = ("--size", 6, "--resolution", 0.1, "--sensor-height", 1.0)
    code, out, err = run("view", recording, "--port", port, *options)
    assert (code, err) == (0, "") and f"open      http://localhost:{port}" in out and "closed" in out
    assert [args[0] for _, *args in shown] == [
        "Scan 1 of 4, 0.0 s",
        "Scan 2 of 4, 0.1 s",
        "Scan 3 of 4, 0.2 s",
        "Scan 4 of 4, 0.3 s",
    ]
    assert run("map", recording, *options)[0] == 0
    expected = export.load_npz(tmp_path / "map.npz").layers["elevation"]
    assert np.array_equal(shown[-1][0].map.layers["elevation"], expected, equal_nan=True)
    assert shown[-1][0].T_map_base[2, 3] == pytest.approx(0.2)  # the base, not the sensor


@pytest.mark.slow(2)
def test_a_bag(run, port, shown, tmp_path):
    code, out, err = run("view", write_drive(tmp_path), "--port", port, "--size", 6)
    assert (code, err) == (0, "") and len(shown) == 6 and len(shown[-1][0].cloud)


@pytest.mark.parametrize("save", [export.save_npz, export.save_map])
def test_a_saved_map(run, port, shown, tmp_path, save):
    emap = mapped(num_envs=1)
    save(tmp_path / "saved.npz", emap)
    code, _, err = run("view", "saved.npz", "--port", port)
    assert (code, err) == (0, "")
    expected = emap.layer("elevation")[0].numpy()
    assert np.array_equal(shown[0][0].map.layers["elevation"], expected, equal_nan=True)


def test_channels_of_a_saved_map(run, port, shown, tmp_path):
    from tests.viz.live.test_page import mapped_channels  # which needs viser

    emap, *_ = mapped_channels()
    export.save_npz(tmp_path / "saved.npz", emap)
    assert run("view", "saved.npz", "--port", port)[0] == 0
    assert list(shown.page._channels) == ["rgb", "terrain"]


@pytest.mark.slow(3)
def test_without_a_recording_the_demo_walks(run, port, shown):
    shown.most = 3
    code, _, err = run("view", "--port", port)
    assert (code, err) == (0, "") and len(shown) == 3 and shown[-1][0].time == pytest.approx(0.4)


@pytest.mark.parametrize(
    "args, words",
    [
        (("nowhere",), "nowhere: no such file or folder"),
        (
            ("map.png",),
            "map.png: is of no kind that can be shown; give a bag (.bag, .mcap, .db3), a folder of scans or",
        ),
        (("drive", "--extrinsics", "1 2"), "12 numbers"),
        (("broken.npz",), "broken.npz"),
        (("drive", "--port", "0"), "0 is not in the range"),
        (("drive", "--host", "nonsense"), "host: must be an address of this machine, got 'nonsense'"),
        (("whole.npz", "--size", "3"), "--size: only for recordings"),
        (("drive", "--points", "/cloud"), "--points: for bags only"),
    ],
)
def test_bad_input_is_one_line(run, recording, shown, tmp_path, args, words):
    (tmp_path / "broken.npz").write_bytes(b"PK but no more")
    (tmp_path / "map.png").write_bytes(b"")
    export.save_npz(tmp_path / "whole.npz", mapped(num_envs=1))
    code, _, err = run("view", *args)
    assert code == 2 and words in err and "Traceback" not in err and not shown


def test_ctrl_c_ends_the_wait_of_a_paused_player(run, recording, port, monkeypatch):
    from torchelev.viz.live import Player

    waits = []

    def wait(self, snapshot):
        waits.append("begun")
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
        waits.append("ended")

    monkeypatch.setattr(Player, "show", wait)
    code, out, err = run("view", recording, "--port", port, "--paused", "--size", 6)
    assert (code, err, waits) == (0, "", ["begun"]) and "closed" in out


@pytest.mark.slow(3)
def test_the_page_opens_before_torch_is_imported(port, tmp_path):
    code = """
import sys
from torchelev.app.commands import view
view.address_of = lambda server: "torch" in sys.modules
view.view_command(["--port", sys.argv[1], sys.argv[2]])
"""
    file = tmp_path / "map.png"
    file.touch()
    command = [sys.executable, "-c", code, str(port), str(file)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert result.stdout.startswith("open      False") and "is of no kind" in result.stderr


@pytest.mark.slow(8)
def test_ctrl_c_closes_the_page(recording, port):
    command = [
        sys.executable,
        "-m",
        "torchelev",
        "view",
        str(recording),
        "--port",
        str(port),
        "--paused",
        "--size",
        "6",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ})
    try:
        assert f"localhost:{port}" in process.stdout.readline()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}") as page:
            assert b"<html" in page.read().lower()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0 and "closed" in out and "Traceback" not in err, err
