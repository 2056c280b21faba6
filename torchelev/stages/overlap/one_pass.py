"""Other floors cleared by C++ or CUDA kernels (`torchelev/native/overlap`): the same as `clear_by_tensors`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.native import kernels
from torchelev.native.library import load
from torchelev.ops.define import operator
from torchelev.ops.native import run
from torchelev.stages.fast_layers import layers_of, layers_to_change, named, new_numbers, put
from torchelev.stages.overlap.config import OverlapConfig
from torchelev.state import MapState, partial_state

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8

STANCE = 0.5  # [m] half the size of the ground that a robot stands on
READ = ("elevation", "upper_bound", "time")  # in the order of C++, like CHANGED
CHANGED = ("validity", "bounded", "challenger_support")
_CONFIG = ("radius", "height", "base_height", "max_base_height")  # of the config; those of C++ are made of them
_LIBRARY = "overlap/overlap.cpp", {"STANCE": f"{STANCE!r}f"}
_SOURCE, _PART = "overlap/overlap.cu", 4096  # cells of a block, as in the source
_SUMS = 5  # of a part of a map, as in the source


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
    """`Settings` of floor.h."""

    _fields_ = (
        *((name, ctypes.c_float) for name in ("radius_square", "slope", *_CONFIG[1:])),
        *((name, ctypes.c_int32) for name in ("first_row", "end_row", "first_column", "end_column")),
    )


def in_one_pass(twin: Clear) -> Callable[..., Cleared]:
    """Return a function that does what its twin does, and calls it where neither C++ nor kernels run."""

    @operator(
        "clear_other_floors(Tensor x, Tensor y, Tensor base, int[] part, Tensor[] layers, Tensor(a!)[] changed, "
        "float[] settings) -> Tensor",
        lambda x, *_: new_numbers(x),
    )
    def clear_layers(
        x: Tensor,
        y: Tensor,
        base: Tensor,
        part: list[int],
        layers: list[Tensor],
        changed: list[Tensor],
        settings: list[float],
    ) -> Tensor:
        number, own = new_numbers(x), _c_settings(part, settings)
        if kernels.work_on(x):
            _launch([x, y, base], layers, changed, number, own)
            return number
        library = load(*_LIBRARY) if x.is_cpu else None
        if library is None or layers[0].numel() == 0:
            cfg = OverlapConfig(**dict(zip(_CONFIG, settings, strict=True)))
            around = Around(x, y, base, (part[0], part[1], part[2], part[3]))
            state = partial_state(**named((*READ, *CHANGED), [*layers, *changed]))
            *left, number = twin(state, around, cfg)
            put(changed, CHANGED, partial_state(**dict(zip(CHANGED, left, strict=True))))
            return number
        written = [*changed, number]
        run(library.clear_other_floors, [x, y, base, *layers], written, *layers[0].shape, ctypes.byref(own))
        return number

    def clear(state: MapState, around: Around, cfg: OverlapConfig, into: MapState | None = None) -> Cleared:
        x, y, base, part = around
        settings = [float(getattr(cfg, name)) for name in _CONFIG]
        layers, changed = layers_of(state, READ), layers_to_change(state, CHANGED, into)
        number = clear_layers(x, y, base, list(part), layers, changed, settings)
        return Cleared(number=number, **named(CHANGED, changed))

    return clear


def _c_settings(part: list[int], settings: list[float]) -> _Settings:
    radius, height, *_ = settings
    return _Settings(radius**2, height / radius, *settings[1:], *part)


def _launch(
    around: list[Tensor], layers: list[Tensor], changed: list[Tensor], number: Tensor, settings: _Settings
) -> None:
    """Clear cells by kernels, and count them."""
    B, H, W = layers[0].shape
    blocks = B * -(-H * W // _PART)
    around, layers = [value.contiguous() for value in around], [layer.contiguous() for layer in layers]
    places, maps = kernels.addresses_of(around), kernels.addresses_of([*layers, *changed, number.zero_()])
    with torch.cuda.device_of(layers[0]):
        sums = layers[0].new_empty(blocks, _SUMS)
        below = places, maps, sums, H, W, ctypes.c_float(STANCE), settings
        kernels.launch_blocks(_SOURCE, "sum_below", blocks, kernels.SUM_MEMORY, *below)
        kernels.launch_blocks(_SOURCE, "clear_other_floors", blocks, 0, places, maps, sums, H, W, settings)
