"""Other floors cleared in one pass of C++ (`torchelev/native/overlap`): the same as `clear_by_tensors`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.native.library import load
from torchelev.ops.define import operator
from torchelev.ops.native import run
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.stages.cpp_layers import layers_of, named, new_layers
from torchelev.stages.overlap.config import OverlapConfig
from torchelev.state import MapState, partial_state

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8

STANCE = 0.5  # [m] half the size of the ground that a robot stands on
READ = ("elevation", "upper_bound", "time", "validity", "bounded", "challenger_support")  # in the order of C++
_NUMBERS = ("radius", "height", "base_height", "max_base_height")  # of the config; those of C++ are made of them
_LIBRARY = "overlap/overlap.cpp", {"STANCE": f"{STANCE!r}f"}


class Around(NamedTuple):
    """Where the cells lie, as seen from the robots' bases."""

    x: Float[Tensor, "B H 1"]  #: [m] from the base to the cells' centres
    y: Float[Tensor, "B 1 W"]  #: [m] from the base to the cells' centres
    base: Float[Tensor, "B 1 1"]  #: [m] height of the base
    part: tuple[int, int, int, int]  #: rows from, rows to, columns from, columns to that may be near; ends excluded


class Cleared(NamedTuple):
    """What is left of the cells."""

    validity: Bool[Tensor, "B H W"]  #: see `MapState`
    bounded: Bool[Tensor, "B H W"]  #: see `MapState`
    challenger_support: UInt8[Tensor, "B H W"]  #: see `MapState`
    number: Int[Tensor, "B"]  #: of cells whose heights were cleared


Clear = Callable[[MapState, Around, OverlapConfig], Cleared]


class _Settings(ctypes.Structure):
    """`Settings` of overlap.cpp."""

    _fields_ = (
        *((name, ctypes.c_float) for name in ("radius_square", "slope", *_NUMBERS[1:])),
        *((name, ctypes.c_int32) for name in ("first_row", "end_row", "first_column", "end_column")),
    )


def in_one_pass(twin: Clear) -> Clear:
    """Return a function that does what its twin does, and calls it where C++ cannot be built."""

    @operator(
        "clear_other_floors(Tensor x, Tensor y, Tensor base, int[] part, Tensor[] layers, float[] settings) "
        "-> Tensor[]",
        _fake,
    )
    def clear_layers(
        x: Tensor, y: Tensor, base: Tensor, part: list[int], layers: list[Tensor], settings: list[float]
    ) -> list[Tensor]:
        library = load(*_LIBRARY)
        if library is None or layers[0].numel() == 0:
            cfg = OverlapConfig(**dict(zip(_NUMBERS, settings, strict=True)))
            left = twin(
                partial_state(**named(READ, layers)), Around(x, y, base, (part[0], part[1], part[2], part[3])), cfg
            )
            return [as_bytes(left.validity), as_bytes(left.bounded), left.challenger_support, left.number]
        cleared = _fake(x, y, base, part, layers)
        radius, height, *_ = settings
        own = _Settings(radius**2, height / radius, *settings[1:], *part)
        run(library.clear_other_floors, [x, y, base, *layers, *cleared], *layers[0].shape, ctypes.byref(own))
        return cleared

    def clear(state: MapState, around: Around, cfg: OverlapConfig) -> Cleared:
        x, y, base, part = around
        settings = [float(getattr(cfg, name)) for name in _NUMBERS]
        layers = layers_of(state, READ)
        validity, bounded, support, number = clear_layers(x, y, base, list(part), layers, settings)
        return Cleared(as_mask(validity), as_mask(bounded), support, number)

    return clear


def _fake(x: Tensor, y: Tensor, base: Tensor, part: list[int], layers: list[Tensor], *_: object) -> list[Tensor]:
    return [*new_layers(READ, layers, Cleared._fields[:-1]), x.new_empty(x.shape[0], dtype=torch.int64)]
