"""Frames in, a video out that others can play, or an error before there is a file."""

import numpy as np
import pytest
from PIL import Image

from tests.helpers import without
from torchelev.files.output_files import WriteError
from torchelev.viz.map_frames import MapFrames
from torchelev.viz.video import VideoWriter

COLORS = MapFrames.colors()


def plain(k, shape=(48, 64)):
    """A frame of one colour of the palette."""
    return np.broadcast_to(COLORS[20 * k], (*shape, 3)).copy()


def read_frames(path):
    """The frames of a video as RGB, (T, height, width, 3)."""
    if path.suffix.lower() == ".gif":
        picture = Image.open(path)
        return np.stack([np.asarray(picture.convert("RGB")) for k in range(picture.n_frames) if not picture.seek(k)])
    av = pytest.importorskip("av")
    with av.open(path) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "A.GIF"])
def test_frames_come_back(tmp_path, name):
    pytest.importorskip("av")
    writer = VideoWriter(tmp_path / name, 10, COLORS)
    for k in range(7):
        writer.add(plain(k))
    assert list(tmp_path.glob("a*")) == [], "the video appears when it is finished"
    writer.close()
    writer.close()
    frames = read_frames(tmp_path / name)
    assert frames.shape == (7, 48, 64, 3) and writer.num == 7
    for k, frame in enumerate(frames):
        assert np.abs(frame.astype(int) - plain(k)).max() <= 8


def test_a_gif_plays_at_its_rate_again_and_again(tmp_path):
    writer = VideoWriter(tmp_path / "a.gif", 10, COLORS)
    for k in range(3):
        writer.add(plain(k))
    writer.close()
    info = Image.open(tmp_path / "a.gif").info
    assert (info["duration"], info["loop"]) == (100, 0)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_without_frames_an_older_file_stays(tmp_path, name):
    pytest.importorskip("av")
    (tmp_path / name).write_bytes(b"older")
    VideoWriter(tmp_path / name, 10, COLORS).close()
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]


def test_what_cannot_be_written_is_refused_at_once(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="path: must be a video's, got a.avi; name it .mp4 or .gif"):
        VideoWriter(tmp_path / "a.avi", 10, COLORS)
    with pytest.raises(WriteError, match="gone/a.gif: cannot be written"):
        VideoWriter(tmp_path / "gone" / "a.gif", 10, COLORS)
    without(monkeypatch, "av")
    VideoWriter(tmp_path / "a.gif", 10, COLORS)
    with pytest.raises(ModuleNotFoundError):
        VideoWriter(tmp_path / "a.mp4", 10, COLORS)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_full_disk_is_told_and_leaves_the_older_file(tmp_path, name):
    pytest.importorskip("av")
    resource = pytest.importorskip("resource")
    (tmp_path / name).write_bytes(b"older")
    writer, noise = VideoWriter(tmp_path / name, 10, COLORS), np.random.default_rng(0)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(WriteError, match=f"{name}: cannot be written"):
            for _ in range(100):
                writer.add(noise.choice(COLORS, (200, 200)))
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    writer.close()
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]
