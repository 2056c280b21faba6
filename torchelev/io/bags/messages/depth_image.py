"""Points out of depth images, raw and compressed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.frames.axes import turn
from torchelev.io.bags.messages.camera_info import choose_lens, pixel_rays
from torchelev.io.bags.messages.cloud import Cloud, CloudError, Note
from torchelev.io.bags.messages.depth_png import decode_depth
from torchelev.io.bags.messages.raw import as_bytes, read_pixels

_MILLIMETRES = 1e-3  # [m]
_UNITS = {"16UC1": _MILLIMETRES, "mono16": _MILLIMETRES, "32FC1": 1.0}  # [m] of depth, by encoding
_NEAREST, _FARTHEST, _FARTHEST_FLOAT = 0.05, 10.0, 100.0  # [m] between which the depths of cameras lie
_MOST, _FEW = 0.5, 0.1  # parts of an image
_SATURATED = 65534.5  # units from which on an integer means that nothing is nearer


class CameraSettings(NamedTuple):
    """How depth images of a topic are read."""

    camera: Any  #: CameraInfo
    topic: str = ""  #: of the images
    scale: float | None = None  #: metres per unit of depth; None: that of the encoding
    axes: str = "optical"  #: of the images' frame, see `depth_to_points`


def read_depth_image(message: Any, settings: CameraSettings) -> Cloud:
    """Return the points (h * w, 3) [m] of an Image or CompressedImage of depth, in the frame of the message.

    Raises:
        CloudError: the image holds no depth, or does not fit its CameraInfo.
    """
    is_compressed = hasattr(message, "format")
    scale = settings.scale
    if is_compressed:
        depth = decode_depth(as_bytes(message.data).tobytes(), message.format, scale)
    else:
        depth = _decode(message, scale)
    camera = settings.camera
    if (depth.shape[1], depth.shape[0]) != (camera.width, camera.height):
        actual, expected = f"{depth.shape[1]} x {depth.shape[0]}", f"{camera.width} x {camera.height}"
        raise CloudError(f"the depth image has {actual} pixels, and its CameraInfo {expected}")
    lens, note = choose_lens(camera, settings.topic)
    x, y = pixel_rays(lens, *depth.shape)
    hit = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))
    points = np.stack(turn([x * hit, y * hit, hit], "optical", settings.axes), -1).reshape(-1, 3)
    encoding = message.format if is_compressed else message.encoding
    doubt = _doubt(depth, None if "32FC1" in encoding else _SATURATED * (scale or _MILLIMETRES))
    return Cloud(points, None, tuple(found for found in (note, doubt) if found is not None))


def _decode(message: Any, scale: float | None) -> NDArray[np.float32]:
    """Return an Image's depth (h, w) [m]."""
    if message.encoding not in _UNITS:
        raise CloudError(f"images of {message.encoding} hold no depth; 16UC1 and 32FC1 do")
    image = read_pixels(message, "f4" if message.encoding == "32FC1" else "u2")
    return image.astype(np.float32) * np.float32(_UNITS[message.encoding] if scale is None else scale)


def _doubt(depth: NDArray[np.float32], saturated: float | None) -> Note | None:
    """Return a note if no camera gives such depths: their unit is probably another one.

    Integers beyond `saturated` [m] do not count; None: they are floats, whose background may be far away.
    """
    known = depth[np.isfinite(depth) & (depth > 0) & (depth < (saturated or np.inf))]
    if len(known) < _MOST * depth.size:
        return None
    median, near = float(np.median(known)), float(np.quantile(known, _FEW))
    if median >= _NEAREST and not (median > _FARTHEST if saturated else near > _FARTHEST_FLOAT):
        return None
    text = f"half of the depths are {'below' if median < _NEAREST else 'beyond'} {median:.3g} m, unlikely for a camera"
    return Note(
        f"{text}; if their unit is another one, give its metres: --depth-scale, or the parameter depth_scale", "depths"
    )
