"""Environments in chunks, which an update works on one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch

from torchelev.grid import GridConfig
from torchelev.inputs.update_inputs import Inputs
from torchelev.state import MapState, map_layers

if TYPE_CHECKING:
    from torchelev.levels.compiled import StoredLevels

CPU_CELLS = 2**19  # cells per chunk on a CPU; measured: 128 maps of 64 x 64 cells at a time, 6 % faster than 64


def make_chunks(num_envs: int, grid: GridConfig, device: torch.device, max_envs: int | None) -> list[slice]:
    """Divide the environments into chunks of equal size, up to rounding.

    `max_envs` limits a chunk. None: no limit on a GPU, and on a CPU as many as are fastest.
    """
    if max_envs is None:
        max_envs = max(1, CPU_CELLS // grid.num_cells) if device.type == "cpu" else num_envs
    size = math.ceil(num_envs / math.ceil(num_envs / max_envs))
    return [slice(first, first + size) for first in range(0, num_envs, size)]


def run_in_chunks(
    update: Callable[..., None],
    state: MapState,
    inputs: Inputs,
    chunks: list[slice],
    levels: StoredLevels | None = None,
) -> None:
    """Call `update(state, inputs)`, with the levels as a third argument if any, on chunks of the environments."""
    others = () if levels is None else (levels,)
    if len(chunks) == 1:
        return update(state, inputs, *others)
    for envs in chunks:
        part = map_layers(lambda layer, envs=envs: layer[envs], state)
        of_part: Any = (None if value is None else value[envs] for value in inputs)
        update(part, Inputs(*of_part), *(type(levels)(*(value[envs] for value in levels)) for levels in others))
