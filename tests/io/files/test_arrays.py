"""Arrays that are clouds, and those that only look like some."""

import numpy as np
import pytest

from torchelev.io import RecordingError, read_cloud
from torchelev.io.files.clouds import read_cloud_file

POINTS = np.random.default_rng(0).uniform(-5, 5, (4992, 6)).astype(np.float32)


@pytest.mark.parametrize("array", [POINTS, POINTS[None, :, :3], POINTS[:, :3].reshape(64, 78, 3), POINTS[:1, :3]])
def test_rows_of_points_are_read(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy"), array.reshape(-1, array.shape[-1])[:, :3])


@pytest.mark.parametrize(
    ("array", "cure"),
    [
        (POINTS.T, "save it transposed"),
        (POINTS[:, :5].T, "save it transposed"),
        (POINTS[:, :3].T.reshape(3, 64, 78), "save it transposed"),
        (np.ones((60, 80)), "--intrinsics"),
        (np.ones((60, 80, 1), np.float32), "--intrinsics"),
        (np.ones((1, 60, 80), np.float32), "--intrinsics"),
        (np.ones((64, 1024), np.uint16), "--intrinsics"),
        (np.ones((60, 80, 3), np.uint8), "as of a picture"),
    ],
)
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_images_and_columns_first_are_refused(tmp_path, array, cure, suffix):
    path = tmp_path / f"a{suffix}"
    np.save(path, array) if suffix == ".npy" else np.savez(path, array)
    with pytest.raises(RecordingError, match=cure):
        read_cloud(path)


@pytest.mark.parametrize("kind", ["datetime64[us]", "timedelta64[ns]", "int64"])
def test_times_of_any_kind_become_numbers(tmp_path, kind):
    nanoseconds = 1_700_000_000_000_000_000 + 1000 * np.arange(4)
    times = nanoseconds.astype(f"{kind[:-4]}[ns]").astype(kind) if "64[" in kind else nanoseconds
    cloud = np.zeros(4, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", times.dtype)])
    cloud["t"] = times
    np.save(tmp_path / "a.npy", cloud)
    np.savez(tmp_path / "a.npz", points=POINTS[:4, :3], timestamps=times)
    for name in ("a.npy", "a.npz"):
        np.testing.assert_array_equal(read_cloud_file(tmp_path / name).times, nanoseconds)
