"""Which files of a folder are its scans, and what is said where there are none."""

import pytest

from tests.helpers import mapped
from torchelev.io import RecordingError
from torchelev.io.export import save_npz
from torchelev.io.folders.scan_files import find_scans


def write_scans(folder, names, suffix=".npy"):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / f"{name}{suffix}").write_bytes(b"a scan")


def names(folder, **options):
    return [path.name for path in find_scans(folder, **options)]


def test_natural_order(tmp_path):
    write_scans(tmp_path, ["b_1", "a_10", "a_2", "a"])
    assert names(tmp_path) == ["a.npy", "a_2.npy", "a_10.npy", "b_1.npy"]


def test_precedence_of_folders(tmp_path):
    write_scans(tmp_path / "some", ["c"])
    assert names(tmp_path) == ["c.npy"]
    write_scans(tmp_path, ["b"])
    assert names(tmp_path) == ["b.npy"]
    write_scans(tmp_path / "scans", ["a"])
    assert names(tmp_path) == ["a.npy"]


def test_ignores_hidden_files_notes_and_own_maps(tmp_path):
    write_scans(tmp_path, ["a"], ".npz")
    write_scans(tmp_path, [".hidden"], ".las")
    write_scans(tmp_path, ["poses"], ".txt")
    save_npz(tmp_path / "map.npz", mapped())
    assert names(tmp_path) == ["a.npz"]
    write_scans(tmp_path, ["photo"], ".png")
    assert names(tmp_path, depth=True) == ["photo.png"]


def test_refuses_folders_without_scans(tmp_path):
    with pytest.raises(RecordingError, match="no such file or folder"):
        find_scans(tmp_path / "gone")
    with pytest.raises(RecordingError, match=r"holds no scan; expected .* among \.bin \.npy \.npz"):
        find_scans(tmp_path)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(RecordingError, match=r"holds no scan, only \.txt; .* among \.png \.npy \.npz"):
        find_scans(tmp_path, depth=True)
    with pytest.raises(RecordingError, match="is neither a folder of scans nor a bag"):
        find_scans(tmp_path / "notes.txt")


def test_refuses_unknown_and_mixed_formats(tmp_path):
    write_scans(tmp_path / "only", ["a"], ".las")
    with pytest.raises(RecordingError, match=r"a\.las: unknown format"):
        find_scans(tmp_path / "only")
    write_scans(tmp_path / "some", ["a"])
    write_scans(tmp_path / "some", ["b"], ".xyz")
    with pytest.raises(RecordingError, match=r"b\.xyz: unknown format"):
        find_scans(tmp_path / "some")
    write_scans(tmp_path / "both", ["a"])
    write_scans(tmp_path / "both", ["b"], ".npz")
    with pytest.raises(RecordingError, match=r"several formats: \.npy \.npz"):
        find_scans(tmp_path / "both")
    write_scans(tmp_path / "two" / "left", ["a"])
    write_scans(tmp_path / "two" / "right", ["a"])
    with pytest.raises(RecordingError, match="scans in several folders: left right"):
        find_scans(tmp_path / "two")
