"""Write frames to a video, one at a time: .mp4 by PyAV (``pip install 'torchelev[video]'``), .gif by Pillow."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import GifImagePlugin, Image

from torchelev.errors import require
from torchelev.files.output_files import atomic_file, require_writable

SUFFIXES = (".mp4", ".gif")


class VideoWriter:
    """Writes a video, which appears at its path when it is closed; without frames there is none.

    Memory does not grow with the number of frames.

    Args:
        path: `.mp4` (H.264) or `.gif`.
        fps: frames per second.
        colors: (K, 3) of a GIF's palette, at most 256: one palette for all frames keeps colours from flickering.

    Attributes:
        num: of frames so far.

    Raises:
        ValueError: the path has another suffix.
        WriteError: the path cannot be written.
        ModuleNotFoundError: PyAV is missing, for `.mp4`.
    """

    def __init__(self, path: str | Path, fps: int, colors: NDArray[np.uint8]) -> None:
        self.path, self.num = Path(path), 0
        kind = self.path.suffix.lower()
        require(kind in SUFFIXES, "path", "must be a video's", self.path.name, "name it .mp4 or .gif")
        if kind == ".mp4":
            import av  # noqa: F401  # fail now if it is missing
        require_writable(self.path)
        self._encode = partial(_Mp4, fps=fps) if kind == ".mp4" else partial(_Gif, fps=fps, colors=colors)
        self._encoder: _Mp4 | _Gif | None = None
        self._stack = ExitStack()

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Append a frame (height, width, 3). All have the same size; both sides are even.

        Raises:
            WriteError: the disk is full or faulty. The video is lost then.
        """
        try:
            if self._encoder is None:
                self._encoder = self._encode(self._stack.enter_context(atomic_file(self.path)), pixels.shape)
            self._encoder.add(pixels)
        except Exception as error:
            self._encoder = None
            self._stack.__exit__(type(error), error, error.__traceback__)
            raise
        self.num += 1

    def close(self) -> None:
        """Finish the video and move it to its path; a file that was there is replaced.

        Raises:
            WriteError: the disk is full or faulty.
        """
        encoder, self._encoder = self._encoder, None
        with self._stack:
            if encoder is not None:
                encoder.close()


class _Mp4:
    """H.264 in the pixel format that every player knows."""

    def __init__(self, file: BinaryIO, shape: tuple[int, ...], fps: int) -> None:
        import av

        self._container = av.open(file, "w", format="mp4")
        self._stream = self._container.add_stream("libx264", rate=fps, options={"crf": "20", "preset": "veryfast"})
        self._stream.height, self._stream.width, self._stream.pix_fmt = shape[0], shape[1], "yuv420p"

    def add(self, pixels: NDArray[np.uint8]) -> None:
        import av

        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))

    def close(self) -> None:
        self._container.mux(self._stream.encode(None))
        self._container.close()


class _Gif:
    """Frames are written as they come; Pillow's `save` would hold all of them."""

    def __init__(self, file: BinaryIO, shape: tuple[int, ...], fps: int, colors: NDArray[np.uint8]) -> None:
        self._file, self._milliseconds = file, round(1000 / fps)
        self._palette = Image.new("P", (shape[1], shape[0]))
        self._palette.putpalette(np.resize(colors, (256, 3)).tobytes())
        self._write(GifImagePlugin.getheader(self._palette, info={"loop": 0})[0])

    def add(self, pixels: NDArray[np.uint8]) -> None:
        picture = Image.fromarray(pixels).quantize(palette=self._palette, dither=Image.Dither.NONE)
        self._write(GifImagePlugin.getdata(picture, duration=self._milliseconds))

    def close(self) -> None:
        self._write([b";"])

    def _write(self, parts: Sequence[bytes]) -> None:
        for part in parts:
            self._file.write(part)
