"""A topic of images of class labels: which numbers it holds, and how its camera sees."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag, Topic
from torchelev.io.bags.cameras import CAMERA, camera_info
from torchelev.io.bags.messages.camera_info import choose_lens
from torchelev.io.bags.messages.cloud import CloudError
from torchelev.io.bags.messages.raw import as_bytes, read_pixels
from torchelev.io.bags.scans import IMAGES, clean
from torchelev.io.bags.topics import BagRequest, absence, name_topics
from torchelev.io.errors import RecordingError
from torchelev.io.folders.recording import Frame
from torchelev.io.labels import LabelImage

_KINDS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
_READABLE = f"labels are images of {', '.join(_KINDS)}, or a PNG of one channel"
_MAX_CLASSES = 64  # that are found in a bag: each is a layer of the map
_MAX_COEFFICIENTS, _NO_DISTORTION = 8, 1e-6
_SIDES = 0.02  # by which the ratio of an image's sides may differ from its CameraInfo's


class LabelTopic:
    """The images of labels of a bag.

    Args:
        bag: an open bag.
        types: its topics by name.
        request: names the topic, its CameraInfo and the classes.
        show: wraps the iteration over messages, for a progress bar.

    Attributes:
        name: of the topic.
        num_classes: C, of the names in the request, or of the labels in the bag.
        frame: of the camera.

    Raises:
        RecordingError: the topic is missing or holds no labels, or its camera is not known. It names the option.
    """

    def __init__(self, bag: Bag, types: dict[str, Topic], request: BagRequest, show: Any = iter) -> None:
        assert request.semantic is not None
        self.name, self._bag = request.semantic, bag
        kind = types[self.name].type if self.name in types else absence(bag, self.name)
        if kind not in IMAGES:
            have = name_topics([topic for topic in types.values() if topic.type in IMAGES])
            raise RecordingError(bag.path, f"--semantic {self.name} is {kind}", f"topics of images are {have}")
        self._camera = self._read_camera(types, request.semantic_info)
        first = next(bag.read([self.name]), None)
        if first is None:
            raise RecordingError(bag.path, f"--semantic {self.name} holds no message", "record it with the scans")
        try:
            read_labels(first.data)
        except CloudError as error:
            raise RecordingError(bag.path, f"--semantic {self.name}: {error}", _READABLE) from error
        self.frame = clean(first.data.header.frame_id)
        self.num_classes = len(request.classes) or self._count_classes(show)

    def _read_camera(self, types: dict[str, Topic], asked: str | None) -> Any:
        info = camera_info(self._bag, types, self.name, "--semantic-info") if asked is None else asked
        if info not in types or types[info].type != CAMERA:
            kind = types[info].type if info in types else absence(self._bag, info)
            have = name_topics([topic for topic in types.values() if topic.type == CAMERA])
            raise RecordingError(self._bag.path, f"--semantic-info {info} is {kind}", f"such topics are {have}")
        message = next(self._bag.read([info]), None)
        if message is None:
            raise RecordingError(self._bag.path, f"{info} holds no message", "record it with the images")
        return message.data

    def _count_classes(self, show: Any) -> int:
        """Return the largest label of the bag plus one, at least two."""
        largest = 1
        for message in show(self._bag.read([self.name])):
            try:
                labels = read_labels(message.data)
            except CloudError:
                continue  # reported when it is to be painted
            largest = max(largest, int(np.max(labels, where=~_is_void(labels), initial=0)))
        if largest >= _MAX_CLASSES:
            reason = f"--semantic {self.name} holds labels up to {largest}, more than {_MAX_CLASSES} classes"
            raise RecordingError(self._bag.path, reason, "name those to be mapped with --classes")
        return largest + 1

    def read(self, message: Any, T_map_camera: NDArray[np.float64]) -> tuple[LabelImage, list[str]]:
        """Return an image of the topic, and notes on what is not used of it.

        Raises:
            CloudError: it holds no labels, or does not fit its CameraInfo.
        """
        labels, camera = read_labels(message), self._camera
        lens, note = choose_lens(camera, self.name)
        notes = [] if note is None else [note.text]
        if lens.is_fisheye or np.abs(lens.distortion[_MAX_COEFFICIENTS:]).max(initial=0.0) > _NO_DISTORTION:
            raise CloudError("the lens is none that images are painted with; give the topic of rectified images")
        unnamed = ~_is_void(labels) & (labels >= self.num_classes)
        if unnamed.any():
            notes.append(f"labels from {self.num_classes} have no name in --classes, and are left out")
        K = scale_matrix(lens.matrix, (camera.width, camera.height), (labels.shape[1], labels.shape[0]))
        return LabelImage(labels, K, T_map_camera, lens.distortion[:_MAX_COEFFICIENTS]), notes


def _is_void(labels: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return where labels are the largest number of their type, by which data sets say that there is none."""
    return labels == np.iinfo(labels.dtype).max


def scale_matrix(
    matrix: tuple[float, float, float, float], size: tuple[int, int], actual: tuple[int, int]
) -> NDArray[np.float64]:
    """Return K (3, 3) for images of another size, as networks make them of a camera's.

    Args:
        matrix: fx, fy, cx, cy [pixels].
        size: width, height of the images that it is of.
        actual: width, height of the images.

    Raises:
        CloudError: the image shows another part of the scene, as its sides have another ratio.
    """
    x, y = actual[0] / max(size[0], 1), actual[1] / max(size[1], 1)
    if abs(x / max(y, 1e-9) - 1) > _SIDES:
        text = f"the image has {actual[0]} x {actual[1]} pixels, and its CameraInfo {size[0]} x {size[1]}"
        raise CloudError(f"{text}, another ratio of the sides; give the camera's --semantic-info")
    fx, fy, cx, cy = matrix
    return np.array([[fx * x, 0.0, (cx + 0.5) * x - 0.5], [0.0, fy * y, (cy + 0.5) * y - 0.5], [0.0, 0.0, 1.0]])


def read_labels(message: Any) -> NDArray[np.integer]:
    """Return the labels (h, w) of an Image, or of a CompressedImage that holds a PNG.

    Raises:
        CloudError: it holds none.
    """
    if hasattr(message, "format"):
        return _decode_png(as_bytes(message.data), message.format)
    if message.encoding not in _KINDS:
        raise CloudError(f"images of {message.encoding} hold no labels")
    labels = read_pixels(message, _KINDS[message.encoding])
    return labels.astype(labels.dtype.newbyteorder("="))


def _decode_png(data: NDArray[np.uint8], encoding: str) -> NDArray[np.integer]:
    import cv2

    image = None
    if data[:4].tobytes() == b"\x89PNG":  # a JPEG blends the labels of neighbours
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype.kind != "u":
        raise CloudError(f"compressed images of {encoding!r} hold no labels")
    return image.astype(np.uint16) if image.dtype == np.uint16 else image.astype(np.uint8)


def attach_images(events: Iterable[Frame | LabelImage | None]) -> Iterator[Frame | None]:
    """Yield frames with the images that follow them; images before the first frame find no map, and are left out."""
    held: Frame | None = None
    for event in events:
        if isinstance(event, LabelImage):
            held = None if held is None else held._replace(images=(*held.images, event))
            continue
        if event is not None and held is not None:
            yield held
        if event is None:
            yield None
        else:
            held = event
    if held is not None:
        yield held
