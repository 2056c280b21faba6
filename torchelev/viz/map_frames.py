"""The frames of a video of a growing map, drawn as pixels: matplotlib would take longer than the mapping.

Needs ``pip install 'torchelev[io]'``.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from torchelev.viz.palette import ROBOT_COLOR, UNKNOWN_COLOR
from torchelev.viz.picture import round_length
from torchelev.viz.relief import draw_relief, relief_colors, rgb

_FONT_FILE = Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf")
_GREY = (90, 90, 90)
_CONTRACTION = 0.05  # part by which the colours' limits come closer in a frame; they widen at once
_SHIFT = 4  # bits of a pixel's fraction in OpenCV


class _Layout(NamedTuple):
    """Places in a frame [pixels]: of the map, and of the colour bar to its right."""

    left: int
    top: int
    width: int
    height: int
    bar: int  # left edge of the colour bar
    size: tuple[int, int]  # of the frame, both even, as videos need


class MapFrames:
    """Draws a map as it grows: shaded heights with a colour bar, the robot's path, unknown cells grey.

    Args:
        shape: (H, W) of the map.
        resolution: [m] of a cell.
        title: above the map.
        side: [pixels] of the map's longer side, about: a small cell is a square of whole pixels.
    """

    def __init__(self, shape: tuple[int, int], resolution: float, title: str = "", side: int = 720) -> None:
        self.resolution = resolution
        ratio = side / max(shape)
        self._scale = float(max(1, round(ratio))) if ratio > 0.7 else ratio  # [pixels / cell]
        self._font_size = max(11, round(side / 45))
        self._font = ImageFont.truetype(str(_FONT_FILE), self._font_size)
        self._layout = self._arrange(shape)
        self._limits: tuple[float, float] | None = None
        self._blank = self._draw_blank(title)

    @staticmethod
    def colors() -> NDArray[np.uint8]:
        """Return the colours (K, 3) of all frames, for videos with a palette."""
        steps = np.linspace(0, 1, 6)[:, None]
        white, black = np.full(3, 255), np.zeros(3)
        path, grey = rgb(ROBOT_COLOR), rgb(UNKNOWN_COLOR)[None]
        lines = [white + steps * (black - white), white + steps * (path - white), grey]
        return np.concatenate([relief_colors(), *(np.round(line) for line in lines)]).astype(np.uint8)

    def draw(self, values: NDArray, center: NDArray, path_xy: NDArray, caption: str = "") -> NDArray[np.uint8]:
        """Draw a frame.

        Args:
            values: (H, W) [m] the elevation, NaN where unknown.
            center: (2,) [m] the middle of the map, map frame.
            path_xy: (T, 2) [m] the robot's places so far, map frame; the last one becomes a dot.
            caption: above the map, at the right.

        Returns:
            (height, width, 3) the pixels; each frame has the same size.
        """
        low, high = self._follow(values)
        place, frame = self._layout, self._blank.copy()
        cells = draw_relief(values, self.resolution, low, high)
        nearest = cv2.INTER_NEAREST if self._scale >= 1 else cv2.INTER_AREA
        pixels = np.asarray(cv2.resize(cells, (place.width, place.height), interpolation=nearest), dtype=np.uint8)
        corner = np.asarray(center)[:2] - np.array(values.shape) * self.resolution / 2
        self._draw_path(pixels, (np.asarray(path_xy) - corner) * (self._scale / self.resolution))
        frame[place.top : place.top + place.height, place.left : place.left + place.width] = pixels
        picture = Image.fromarray(frame)
        draw = ImageDraw.Draw(picture)
        self._draw_axes(draw, corner, values.shape)
        self._draw_bar_ticks(draw, low, high)
        self._write(draw, (place.left + place.width, place.top - self._font_size // 2), caption, "rd")
        return np.asarray(picture)

    def _arrange(self, shape: tuple[int, int]) -> _Layout:
        em = self._font_size
        width, height = (max(1, round(cells * self._scale)) for cells in shape)
        left, top, bar = 5 * em, 2 * em, 5 * em + width + em
        size = bar + 8 * em, max(height, 12 * em) + 6 * em
        return _Layout(left, top, width, height, bar, (size[0] + size[0] % 2, size[1] + size[1] % 2))

    def _draw_blank(self, title: str) -> NDArray[np.uint8]:
        """Draw the common parts of all frames: title, names of the axes, colours."""
        place, em = self._layout, self._font_size
        picture = Image.new("RGB", place.size, "white")
        draw = ImageDraw.Draw(picture)
        self._write(draw, (place.left, place.top - em // 2), title, "ld")
        self._write(draw, (place.left + place.width // 2, place.top + place.height + 2 * em), "x [m]", "ma")
        upright = Image.new("RGB", (3 * em, em + em // 2), "white")
        self._write(ImageDraw.Draw(upright), (upright.width // 2, upright.height // 2), "y [m]", "mm")
        picture.paste(upright.rotate(90, expand=True), (0, place.top + (place.height - upright.width) // 2))
        self._write(draw, (place.bar, place.top), "elevation [m]", "la")
        box = place.bar, self._bar_bottom + em, place.bar + em, self._bar_bottom + 2 * em
        draw.rectangle(box, fill=UNKNOWN_COLOR, outline=_GREY)
        self._write(draw, (box[2] + em // 2, self._bar_bottom + em), "unknown", "la")
        frame = np.array(picture)
        rows = self._bar_bottom - self._bar_top
        heights = np.linspace(0, 1, rows, dtype=np.float32)[None]
        frame[self._bar_top : self._bar_bottom, place.bar : place.bar + em] = draw_relief(heights, math.inf, 0, 1)
        return frame

    @property
    def _bar_top(self) -> int:
        return self._layout.top + 2 * self._font_size

    @property
    def _bar_bottom(self) -> int:
        return max(self._layout.top + self._layout.height, self._layout.top + 8 * self._font_size) - 3 * self._font_size

    def _follow(self, values: NDArray) -> tuple[float, float]:
        """Return the heights [m] of the first and last colour: they widen with the map, and narrow slowly."""
        known = values[np.isfinite(values)]
        if known.size:
            low, high = (float(value) for value in np.percentile(known, [1, 99]))
            if self._limits is not None:
                low = min(low, self._limits[0] + _CONTRACTION * (low - self._limits[0]))
                high = max(high, self._limits[1] + _CONTRACTION * (high - self._limits[1]))
            self._limits = low, high
        low, high = self._limits or (0.0, 1.0)
        middle, half = (low + high) / 2, max((high - low) / 2, 0.05)
        return middle - half, middle + half

    def _draw_path(self, pixels: NDArray[np.uint8], path: NDArray) -> None:
        """Draw a path (T, 2) [pixels] from the map's corner with the smallest x and y."""
        if not len(path):
            return
        width = max(2, self._font_size // 8)
        points = np.column_stack([path[:, 0], len(pixels) - path[:, 1]]) - 0.5
        points = np.round(np.clip(points, -1e6, 1e6) * 2**_SHIFT).astype(np.int32)
        dot = tuple(int(value) for value in points[-1])
        color = tuple(int(value) for value in rgb(ROBOT_COLOR))
        for extra, fill in ((2, (255, 255, 255)), (0, color)):
            cv2.polylines(pixels, [points[:, None]], False, fill, width + extra, cv2.LINE_AA, _SHIFT)
        for extra, fill in ((2, (255, 255, 255)), (0, color)):
            radius = (2 * width + 2 + extra) << _SHIFT
            cv2.circle(pixels, dot, radius, fill, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def _draw_axes(self, draw: ImageDraw.ImageDraw, corner: NDArray, shape: tuple[int, ...]) -> None:
        """Draw the map's border with places in the map frame, which move past as the window moves."""
        place, tick = self._layout, self._font_size // 3
        right, bottom = place.left + place.width, place.top + place.height
        draw.rectangle((place.left - 1, place.top - 1, right, bottom), outline=_GREY)
        for axis, pixels in enumerate((place.width, place.height)):
            length = shape[axis] * self.resolution
            for value, text in _ticks(corner[axis], corner[axis] + length, length / 4):
                offset = round((value - corner[axis]) / length * pixels)
                if axis == 0:
                    draw.line((place.left + offset, bottom, place.left + offset, bottom + tick), fill=_GREY)
                    self._write(draw, (place.left + offset, bottom + 2 * tick), text, "ma")
                else:
                    draw.line((place.left - 1 - tick, bottom - offset, place.left - 1, bottom - offset), fill=_GREY)
                    self._write(draw, (place.left - 2 * tick, bottom - offset), text, "rm")

    def _draw_bar_ticks(self, draw: ImageDraw.ImageDraw, low: float, high: float) -> None:
        left, pixels = self._layout.bar + self._font_size, self._bar_bottom - self._bar_top
        tick = self._font_size // 3
        for value, text in _ticks(low, high, (high - low) / 3):
            y = self._bar_bottom - round((value - low) / (high - low) * (pixels - 1)) - 1
            draw.line((left, y, left + tick, y), fill=_GREY)
            self._write(draw, (left + 2 * tick, y), text, "lm")

    def _write(self, draw: ImageDraw.ImageDraw, xy: tuple[int, int], text: str, anchor: str) -> None:
        draw.text(xy, text, fill="black", font=self._font, anchor=anchor)


def _ticks(low: float, high: float, max_step: float) -> list[tuple[float, str]]:
    """Return round values between two limits, with their texts."""
    step = round_length(max_step)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    values = [step * k for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
    return [(value, f"{value + 0.0:.{decimals}f}") for value in values]
