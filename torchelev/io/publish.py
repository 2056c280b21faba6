"""Publish layers at a rate: copies in CPU memory, made without waiting for the device."""

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

CLOCK_ROUNDING = 1e-6  # [s] by which readings of a clock may come early


class Published(NamedTuple):
    """Layers as they were at `stamp`, for the caller to keep: nothing writes to them later."""

    layers: dict[str, NDArray]  #: name -> (B, H, W), NaN where unknown
    center: NDArray  #: (B, 3) [m], map frame
    resolution: float  #: [m]
    stamp: float  #: [s] the `now` of the offer


class Publisher:
    """Copy chosen layers to CPU memory, no more often than `rate` (paper, Sec. II-A: a user-defined frequency).

    Call `offer` as often as you like, say after each update: where a copy is due it starts one, and returns at once.
    `take` gives the newest finished copy. Layers that are wanted at another rate have a publisher of their own.

    On CUDA, copies go to pinned memory in a stream of their own, which waits for what was launched before the offer;
    neither the host nor later updates wait for them. (The first two offers allocate that memory, which takes longer.)
    This path has not run on a GPU yet. On a CPU the copy is finished when `offer` returns; on other devices `offer`
    waits for it.

    Args:
        emap: the map to publish.
        layers: names as of `ElevationMap.layer`.
        rate: [Hz] of the clock that `offer` is given; inf copies at every offer.

    Raises KeyError for an unknown layer, ValueError for no layers and for a rate that is not positive.
    """

    def __init__(self, emap: ElevationMap, layers: Sequence[str] = ("elevation",), rate: float = 5.0) -> None:
        names = not isinstance(layers, str) and len(layers) > 0
        require(names, "layers", "must be a sequence of names", repr(layers), 'give ("elevation",)')
        positive = isinstance(rate, Real) and rate > 0
        require(positive, "rate", "must be positive", repr(rate), "give a number of copies per second")
        for name in layers:
            emap.layer(name)  # refuses what does not exist
        self.emap, self.layers, self.rate = emap, tuple(layers), rate
        self._started = -math.inf
        self._copying: _Copy | None = None
        self._finished: _Copy | None = None
        self._pinned = _PinnedMemory()

    def offer(self, now: float | None = None) -> bool:
        """Start a copy if one is due, and say whether; the host does not wait.

        `now` [s] is a reading of any clock, by default `time.monotonic()`; where it was set back, the rate starts anew.
        Nothing starts while the last copy is under way.
        """
        now = time.monotonic() if now is None else now
        self._collect()
        if self._copying is not None or not self._due(now):
            return False
        self._copying, self._started = self._start(now), now
        return True

    def take(self) -> Published | None:
        """Return the newest finished copy, or None if none was finished since the last one taken; does not wait."""
        self._collect()
        copy, self._finished = self._finished, None
        return None if copy is None else copy.published(self.layers)

    def _due(self, now: float) -> bool:
        return now < self._started or now - self._started >= 1 / self.rate - CLOCK_ROUNDING

    def _collect(self) -> None:
        """Let the copy under way replace the finished one, once the device is done with it."""
        if self._copying is not None and self._copying.done():
            self._copying, self._finished = None, self._copying

    def _start(self, now: float) -> _Copy:
        values = [self.emap.layer(name).detach() for name in self.layers] + [self.emap.center]
        resolution = self.emap.cfg.grid.resolution
        if values[0].is_cuda:
            return _Copy(*self._pinned.start(values), resolution, now)
        return _Copy([value.cpu() for value in values], None, resolution, now)


class _Copy(NamedTuple):
    """Layers, and the centre last, in CPU memory or on their way."""

    values: list[Tensor]
    end: torch.cuda.Event | None  # None: they are there, in memory of their own
    resolution: float
    stamp: float

    def done(self) -> bool:
        return self.end is None or self.end.query()

    def published(self, names: Sequence[str]) -> Published:
        # Pinned memory is written again; everything else is as fresh as `layer` returned it.
        own = self.values if self.end is None else [value.clone() for value in self.values]
        *layers, center = map(as_array, own)
        return Published(dict(zip(names, layers, strict=True)), center, self.resolution, self.stamp)


class _PinnedMemory:
    """Two sets of pinned memory that a CUDA device writes by turns: one under way, one finished."""

    def __init__(self) -> None:
        self._sets: list[list[Tensor]] = [[], []]

    def start(self, values: list[Tensor]) -> tuple[list[Tensor], torch.cuda.Event]:
        """Start to copy into the set that was written last but one; return it, and the event of the copy's end."""
        self._sets.reverse()
        if [_kind(memory) for memory in self._sets[0]] != [_kind(value) for value in values]:
            self._sets[0] = [_pinned_like(value) for value in values]
        memories, end = self._sets[0], torch.cuda.Event()
        stream = torch.cuda.Stream(values[0].device)
        stream.wait_stream(torch.cuda.current_stream(values[0].device))
        with torch.cuda.stream(stream):
            for memory, value in zip(memories, values, strict=True):
                memory.copy_(value, non_blocking=True)
                value.record_stream(stream)  # or the next update might be given its memory
            end.record()
        return memories, end


def _kind(value: Tensor) -> tuple[torch.Size, torch.dtype]:
    return value.shape, value.dtype


def _pinned_like(value: Tensor) -> Tensor:
    with torch.inference_mode(False):  # or it could not be written outside of that mode
        return torch.empty(value.shape, dtype=value.dtype, pin_memory=True)
