"""Every writer leaves the older file whole when it fails, and refuses folders and devices."""

import errno
import os
import resource
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import mapped
from torchelev import TraversabilityNet
from torchelev.app.demo import run_demo
from torchelev.files.output_files import WriteError, atomic_file, is_own_output, require_writable
from torchelev.io.export import save_cloud, save_map, save_mesh, save_npz
from torchelev.viz.picture import save_image
from torchelev.viz.plot import Panel, save_layers

WRITERS = {
    "save_map.npz": lambda path: save_map(path, mapped()),
    "save_npz.npz": lambda path: save_npz(path, mapped()),
    "save_mesh.ply": lambda path: save_mesh(path, mapped()),
    "save_cloud.ply": lambda path: save_cloud(path, mapped()),
    "save_image.png": lambda path: save_image(path, np.random.default_rng(0).uniform(0, 1, (80, 80)), 0.1),
    "save_layers.png": lambda path: save_layers(path, [Panel(title="", values=np.eye(3))], extent=(0, 1, 0, 1)),
    "weights.pt": lambda path: TraversabilityNet.from_pretrained().save(path),
    "demo.png": lambda path: run_demo(path, 0.4, progress=False),
}


@pytest.mark.slow(4)
def test_a_writer_that_fails_leaves_the_older_file(tmp_path):
    """In a process of its own, which may not write files of more than 1 kB."""
    for name in WRITERS:
        (tmp_path / name).write_bytes(b"older")
    code = (
        "import pathlib, resource, sys, pytest; sys.path.insert(0, 'tests/files')\n"
        "from test_output_files import WRITERS, WriteError\n"
        "import torch; torch.__version__ < '2.10' and __import__('torch._dynamo')  # writes files when it is imported\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "for name, write in WRITERS.items():\n"
        "    with pytest.raises(WriteError, match=name + ': cannot be written .*older file is left'):\n"
        f"        write(pathlib.Path({str(tmp_path)!r}) / name)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(WRITERS, b"older")


@pytest.mark.parametrize("name", WRITERS)
def test_every_writer_refuses_folders_and_devices(tmp_path, name):
    path = tmp_path / name
    path.mkdir()
    with pytest.raises(WriteError, match="it is a folder"):
        WRITERS[name](path)
    path.rmdir()
    path.symlink_to("/dev/full")
    with pytest.raises(WriteError, match="it is a device"):
        WRITERS[name](path)
    assert path.is_symlink() and stat.S_ISCHR(os.stat("/dev/full").st_mode) and os.listdir(tmp_path) == [name]


@pytest.mark.slow(2)
@pytest.mark.parametrize("name", WRITERS)
def test_only_what_is_written_for_people_is_told_from_scans(tmp_path, name):
    WRITERS[name](tmp_path / name)
    assert is_own_output(tmp_path / name) == (name != "weights.pt")


def test_others_files_are_no_outputs(tmp_path):
    np.savez(tmp_path / "scan.npz", points=np.zeros((2, 3)))
    (tmp_path / "scan.ply").write_bytes(b"ply\n")
    (tmp_path / "junk.npz").write_bytes(b"PK junk")
    assert not any(map(is_own_output, [*tmp_path.iterdir(), tmp_path / "gone.npz"]))


def test_an_error_within_the_block_writes_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), atomic_file(tmp_path / "a") as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == []


def test_other_errors_pass_through(tmp_path):
    with pytest.raises(RuntimeError, match="of the caller"), atomic_file(tmp_path / "a"):
        raise RuntimeError("of the caller")
    assert os.listdir(tmp_path) == []


def test_a_read_only_disk_is_named(tmp_path, monkeypatch):
    """There even removing a file that does not exist fails."""

    def read_only(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system", ".tmp")

    for name in ("open", "touch", "unlink"):
        monkeypatch.setattr(Path, name, read_only)
    with pytest.raises(WriteError, match="map.npz: cannot be written .Read-only file system"):
        require_writable(tmp_path / "map.npz")
    with pytest.raises(WriteError, match="map.npz: cannot be written .Read-only"), atomic_file(tmp_path / "map.npz"):
        pass


def test_links_and_permissions_stay(tmp_path):
    (tmp_path / "real").write_bytes(b"older")
    (tmp_path / "real").chmod(0o640)
    (tmp_path / "link").symlink_to("real")
    with atomic_file(tmp_path / "link") as file:
        file.write(b"newer")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_bytes() == b"newer"
    assert stat.S_IMODE((tmp_path / "real").stat().st_mode) == 0o640
    mask = os.umask(0o027)
    try:
        with atomic_file(tmp_path / "new"):
            pass
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640


def test_what_cannot_be_written_is_known_before(tmp_path):
    require_writable(tmp_path / "map.npz", 1000)
    for path in (tmp_path / "gone" / "map.npz", tmp_path / ("n" * 300)):
        with pytest.raises(WriteError, match="cannot be written"):
            require_writable(path)
    with pytest.raises(WriteError, match=r"the disk has .* MB, up to 1e\+24 MB are needed"):
        require_writable(tmp_path / "map.npz", 10**30)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, before[1]))
    try:
        require_writable(tmp_path / "map.npz", 5000)
        with pytest.raises(WriteError, match=r"ulimit -f\) is 0.005 MB"):
            require_writable(tmp_path / "map.npz", 5001)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert os.listdir(tmp_path) == []


@pytest.mark.slow(1)
def test_damaged_weights_are_a_value_error_that_names_the_file(tmp_path):
    path, rng = tmp_path / "weights.pt", np.random.default_rng(0)
    TraversabilityNet.from_pretrained().save(path)
    whole = path.read_bytes()
    for k in range(120):
        place = int(rng.integers(0, len(whole) if k % 2 else 400))
        flipped = bytes([whole[place] ^ (1 << int(rng.integers(8)))])
        path.write_bytes(whole[:place] + (flipped + whole[place + 1 :] if k % 3 else b""))
        try:
            TraversabilityNet.from_pretrained(path)
        except ValueError as error:
            assert str(path) in str(error)
