"""Outputs of `torchelev map`: checked before mapping, and written elsewhere if need be."""

import os
import subprocess
import sys

import numpy as np
import pytest

from torchelev.files import output_files
from torchelev.io.export import load_npz


@pytest.mark.slow(1)
@pytest.mark.parametrize("suffix", [".npz", ".png", ".ply"])
@pytest.mark.parametrize("blocked", ["folder", "device"])
def test_outputs_are_checked_before_mapping(run, recording, tmp_path, at_scan, suffix, blocked):
    at_scan(0, lambda: pytest.fail("mapped"))
    path = tmp_path / f"map{suffix}"
    path.mkdir() if blocked == "folder" else path.symlink_to("/dev/full")
    code, _, err = run("map", recording)
    assert code == 2 and err.count("\n") == 1 and f"map{suffix}: cannot be written (it is a {blocked}" in err
    assert run("map", recording, "--out", "/dev/full")[0] == 2


@pytest.mark.slow(1)
def test_the_size_limit_is_checked_before_mapping(recording, tmp_path):
    (tmp_path / "map.npz").write_bytes(b"older")
    command = f"ulimit -f 20; exec {sys.executable} -m torchelev map {recording} --out {tmp_path / 'map'}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "the size limit of files (ulimit -f) is 0.0205 MB" in done.stderr
    assert (tmp_path / "map.npz").read_bytes() == b"older"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive", "map.npz"]


@pytest.mark.slow(2)
@pytest.mark.parametrize("suffix", [".npz", ".png", ".ply"])
def test_what_cannot_be_written_is_kept_elsewhere(run, recording, tmp_path, monkeypatch, suffix):
    assert run("map", recording, "--size", 4)[0] == 0
    older = (tmp_path / f"map{suffix}").read_bytes()
    rename, kept_at = os.replace, tmp_path / "kept"

    def full_disk(source, target):
        if str(target) == str(tmp_path / f"map{suffix}"):
            raise OSError(28, "No space left on device")
        rename(source, target)

    kept_at.mkdir()
    monkeypatch.setattr(output_files.os, "replace", full_disk)
    monkeypatch.setattr("tempfile.tempdir", str(kept_at))
    code, out, err = run("map", recording, "--size", 5)
    (kept,) = kept_at.glob(f"*/map{suffix}")
    assert code == 2 and f"map{suffix}: cannot be written (No space left on device)" in err
    assert f"kept in {kept}" in err and str(kept) in out
    assert (tmp_path / f"map{suffix}").read_bytes() == older and kept.stat().st_size > 1000
    assert not [path for path in tmp_path.iterdir() if path.suffix == ".tmp"]
    assert load_npz(kept if suffix == ".npz" else tmp_path / "map.npz").layers["elevation"].shape == (50, 50)


@pytest.mark.slow(2)
def test_out_may_have_the_suffix_of_an_output(run, recording, tmp_path):
    assert run("map", recording, "--size", 2, "--out", "course.npz")[0] == 0
    assert sorted(path.name for path in tmp_path.glob("course*")) == ["course.npz", "course.ply", "course.png"]


@pytest.mark.slow(2)
def test_layers_of_filters_are_drawn(run, recording, tmp_path, figures):
    (tmp_path / "cfg.yaml").write_text("filters: [{layer: smooth, filter: gaussian, sigma: 0.2}]\n")
    assert run("map", recording, "--config", "cfg.yaml")[0] == 0
    panels = [ax for ax in figures[0].axes if ax.get_title()]
    assert [ax.get_title() for ax in panels[4:]] == ["smooth"]
    drawn = panels[4].images[0].get_array().filled(np.nan)
    np.testing.assert_array_equal(drawn.T, load_npz(tmp_path / "map.npz").layers["smooth"])
