"""Publish layers at a limited rate: copies in CPU memory, made without waiting for the device."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.errors import require
from torchelev.io.map_file import as_array

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

_CLOCK_ROUNDING = 1e-6  # [s] tolerance for rounded clock readings


class Published(NamedTuple):
    """A copy of layers at one instant; it belongs to the caller and never changes."""

    layers: dict[str, NDArray]  #: name -> (B, H, W), NaN where unknown
    center: NDArray  #: (B, 3) [m], map frame
    resolution: float  #: [m]
    stamp: float  #: [s] the `now` given to `offer`


class Publisher:
    """Copy layers to CPU memory, at most at a user-defined rate (paper, Sec. II-A).

    Call `offer` as often as you like, for example after each update: it starts a copy when one is due and returns
    immediately. `take` returns the newest finished copy. Use one publisher per rate.

    On CUDA, copies go to pinned memory in a separate stream, which waits for the work queued before the offer; neither
    the host nor later updates wait for it. Only the first two offers take longer, because they allocate that memory.
    This path has not been run on a GPU yet. On a CPU the copy is finished when `offer` returns; on other devices
    `offer` waits for it.

    Args:
        emap: the map to publish.
        layers: names as in `ElevationMap.layer`.
        rate: [Hz] by the clock given to `offer`; inf: copy at every offer.

    Raises:
        KeyError: a layer does not exist.
        ValueError: there are no layers, or the rate is not positive.
    """

    def __init__(self, emap: ElevationMap, layers: Sequence[str] = ("elevation",), rate: float = 5.0) -> None:
        are_names = not isinstance(layers, str) and len(layers) > 0
        require(are_names, "layers", "must be a sequence of names", repr(layers), 'give ("elevation",)')
        is_positive = isinstance(rate, Real) and rate > 0
        require(is_positive, "rate", "must be positive", repr(rate), "give a number of copies per second")
        for name in layers:
            emap.layer(name)  # raises KeyError for an unknown name
        self.emap, self.layers, self.rate = emap, tuple(layers), rate
        self._started = -math.inf
        self._copying: _Copy | None = None
        self._finished: _Copy | None = None
        self._pinned = _PinnedMemory()

    def offer(self, now: float | None = None) -> bool:
        """Start a copy if one is due and the previous one has finished. The host does not wait.

        Args:
            now: [s] reading of any clock, by default `time.monotonic()`. If the clock is set back, a copy is due.

        Returns:
            Whether a copy was started.
        """
        now = time.monotonic() if now is None else now
        self._collect()
        if self._copying is not None or not self._is_due(now):
            return False
        self._copying, self._started = self._start(now), now
        return True

    def take(self) -> Published | None:
        """Return the newest finished copy, or None if there is none since the last call. The host does not wait."""
        self._collect()
        copy, self._finished = self._finished, None
        return None if copy is None else copy.to_published(self.layers)

    def _is_due(self, now: float) -> bool:
        return now < self._started or now - self._started >= 1 / self.rate - _CLOCK_ROUNDING

    def _collect(self) -> None:
        """Move the copy in progress to the finished one, once the device has completed it."""
        if self._copying is not None and self._copying.is_done():
            self._copying, self._finished = None, self._copying

    def _start(self, now: float) -> _Copy:
        values = [self.emap.layer(name).detach() for name in self.layers] + [self.emap.center]
        resolution = self.emap.cfg.grid.resolution
        if values[0].is_cuda:
            return _Copy(*self._pinned.start(values), resolution, now)
        return _Copy([value.cpu() for value in values], None, resolution, now)


class _Copy(NamedTuple):
    """Layers, followed by the map's centre, in CPU memory or on their way there."""

    values: list[Tensor]
    end: torch.cuda.Event | None  # None: the copy is finished and owns its memory
    resolution: float
    stamp: float

    def is_done(self) -> bool:
        return self.end is None or self.end.query()

    def to_published(self, names: Sequence[str]) -> Published:
        # Pinned memory is reused by later copies.
        values = self.values if self.end is None else [value.clone() for value in self.values]
        *layers, center = map(as_array, values)
        return Published(dict(zip(names, layers, strict=True)), center, self.resolution, self.stamp)


class _PinnedMemory:
    """Two sets of pinned memory used in turn: one for the copy in progress, one for the finished copy."""

    def __init__(self) -> None:
        self._sets: list[list[Tensor]] = [[], []]

    def start(self, values: list[Tensor]) -> tuple[list[Tensor], torch.cuda.Event]:
        """Start copying into the older set; return it and the event that marks the end of the copy."""
        self._sets.reverse()
        if [(memory.shape, memory.dtype) for memory in self._sets[0]] != [
            (value.shape, value.dtype) for value in values
        ]:
            self._sets[0] = [allocate_pinned(value) for value in values]
        memories, end = self._sets[0], torch.cuda.Event()
        stream = torch.cuda.Stream(values[0].device)
        stream.wait_stream(torch.cuda.current_stream(values[0].device))
        with torch.cuda.stream(stream):
            for memory, value in zip(memories, values, strict=True):
                memory.copy_(value, non_blocking=True)
                value.record_stream(stream)  # else an update could reuse its memory before the copy ends
            end.record()
        return memories, end


def allocate_pinned(like: Tensor) -> Tensor:
    """Allocate a pinned tensor in CPU memory with the shape and dtype of `like`."""
    with torch.inference_mode(False):  # an inference tensor could not be written outside of that mode
        return torch.empty(like.shape, dtype=like.dtype, pin_memory=True)
