"""The film: the stage on the left, sixteen maps on the right, as an animated WebP."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path as File

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from docs.moving_picture import batch
from docs.moving_picture.stage import BACKGROUND, CMAP, LIMITS, Stage
from docs.moving_picture.walk import Path, make_ground, walk
from torchelev.files.output_files import atomic_file
from torchelev.viz.palette import ROBOT_COLOR, UNKNOWN_COLOR

FRAMES_PER_SECOND = 15
STAGE_SIZE, TILE, GAP = (760, 560), 96, 6  # [pixels]
SIZE = (STAGE_SIZE[0] + 4 * (TILE + GAP) + 24, STAGE_SIZE[1])
FILM_SIZE = (936, 440)  # [pixels] of the file
_EVERY = 2  # of the frames goes into the file, which stays small
_HOLD, _FADE = 1.0, 0.4  # [s] at the end
_KEY_FRAMES = {"kmin": 3, "kmax": 20}  # few enough for a small file, enough that no trace of the robot stays
_TEXT, _FONT = "#2b2f36", File(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf")
_TOP = 56  # [pixels] above the tiles


def frames(seconds: float | None = None) -> Iterator[Image.Image]:
    """Render the frames of the film, at most `seconds` of it."""
    path = Path(make_ground())
    stage = Stage(path, STAGE_SIZE)
    duration = path.seconds if seconds is None else seconds
    moments = walk(path, FRAMES_PER_SECOND, duration)
    maps = batch.walk_in_circles(batch.make_tiles(), math.ceil(duration * FRAMES_PER_SECOND) + 1, FRAMES_PER_SECOND)
    for moment, (elevation, yaw) in zip(moments, maps, strict=False):
        yield _compose(stage.render(moment), tile_grid(elevation, yaw))


def tile_grid(elevation: NDArray, yaw: NDArray) -> Image.Image:
    """Return 4 x 4 maps from above, each with its robot as an arrow."""
    side = 4 * (TILE + GAP) - GAP
    picture = Image.new("RGB", (side, side), BACKGROUND)
    for k, (heights, heading) in enumerate(zip(elevation, yaw, strict=True)):
        row, column = divmod(k, 4)
        picture.paste(_tile(heights, float(heading)), (column * (TILE + GAP), row * (TILE + GAP)))
    return picture


def _tile(heights: NDArray, heading: float) -> Image.Image:
    low, high = LIMITS
    colors = matplotlib.colormaps[CMAP]((np.nan_to_num(heights) - low) / (high - low))[..., :3]
    lit = batch.shade(heights, colors, batch.GRID.resolution)
    lit[np.isnan(heights).T[::-1]] = to_rgb(UNKNOWN_COLOR)
    tile = Image.fromarray((255 * lit).astype(np.uint8)).resize((TILE, TILE), Image.Resampling.NEAREST)
    return _with_arrow(tile, heading)


def _with_arrow(tile: Image.Image, heading: float) -> Image.Image:
    """Draw an arrow head in the middle, smoothed."""
    large = tile.resize((4 * TILE, 4 * TILE), Image.Resampling.NEAREST)
    angles = heading + np.radians([0, 145, 180, 215])
    radii = 4 * np.array([8, 8, 3, 8])
    points = [(2 * TILE + r * math.cos(a), 2 * TILE - r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]
    ImageDraw.Draw(large).polygon(points, fill=ROBOT_COLOR, outline="white", width=4)
    return large.reduce(4)


def _compose(left: Image.Image, right: Image.Image) -> Image.Image:
    """Put stage and tiles side by side, with captions and a colour bar."""
    picture = Image.new("RGB", SIZE, BACKGROUND)
    picture.paste(left, (0, 0), _margin(left.size))
    x = STAGE_SIZE[0]
    picture.paste(right, (x, _TOP))
    draw = ImageDraw.Draw(picture)
    draw.text((24, 24), "One robot, 300 x 240 cells of 4 cm", fill=_TEXT, font=_font(17))
    draw.text((x, 24), "Sixteen robots, one batched update", fill=_TEXT, font=_font(17))
    _draw_color_bar(picture, x, _TOP + right.height + 24, right.width)
    return picture


def _margin(size: tuple[int, int]) -> Image.Image:
    """Return a mask that fades a frame out under the caption and towards the tiles."""
    x, y = np.arange(size[0]), np.arange(size[1])
    alpha = np.minimum(((size[0] - 12 - x) / 36).clip(0, 1), ((y[:, None] - 44) / 24).clip(0, 1))
    return Image.fromarray((255 * alpha).astype(np.uint8))


def _draw_color_bar(picture: Image.Image, x: int, y: int, width: int) -> None:
    ramp = matplotlib.colormaps[CMAP](np.linspace(0, 1, width), bytes=True)[None, :, :3].repeat(10, axis=0)
    picture.paste(Image.fromarray(np.ascontiguousarray(ramp)), (x, y))
    draw, font = ImageDraw.Draw(picture), _font(14)
    labels = ((f"{LIMITS[0]:g}", 0, "la"), ("height [m]", width / 2, "ma"), (f"{LIMITS[1]:g}", width, "ra"))
    for text, at, anchor in labels:
        draw.text((x + at, y + 15), text, fill=_TEXT, font=font, anchor=anchor)


def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(_FONT), size)


def save_film(images: Sequence[Image.Image], path: File, first: int = 0, max_bytes: int = 1_200_000) -> None:
    """Write an endless loop as WebP, in the best quality below `max_bytes`, or the least one.

    It begins at the frame `first`, as pages show the first one while they load. The last frame stays, then fades.
    """
    first //= _EVERY
    images = [image.resize(FILM_SIZE, Image.Resampling.LANCZOS) for image in images[::_EVERY]]
    blank = Image.new("RGB", FILM_SIZE, BACKGROUND)
    steps, dt = round(_FADE * FRAMES_PER_SECOND / _EVERY), 1000 * _EVERY / FRAMES_PER_SECOND
    faded = [Image.blend(images[-1], blank, k / steps) for k in range(1, steps + 1)]
    durations = [round(dt)] * (len(images) - 1) + [round(1000 * _HOLD)] + [round(dt)] * steps
    images, durations = [*images[first:], *faded, *images[:first]], [*durations[first:], *durations[:first]]
    for quality in (80, 70, 60, 50, 40, 30, 20):
        data = io.BytesIO()
        images[0].save(
            data, format="webp", save_all=True, append_images=images[1:], duration=durations, loop=0,
            quality=quality, method=4, **_KEY_FRAMES,
        )  # fmt: skip
        if data.tell() <= max_bytes:
            break
    with atomic_file(path) as file:
        file.write(data.getvalue())
