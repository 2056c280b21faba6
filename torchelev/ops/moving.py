"""Move layers by whole cells, each environment by its own shift."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.ops.indexing import read
from torchelev.ops.transforms import is_readable

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

HOST_ENVIRONMENTS = 4  # up to so many environments copying beats gathering


def move_layers(layers: dict[str, Tensor], shift: Int[Tensor, "B 2"], blank: dict[str, float]) -> dict[str, Tensor]:
    """Shift layers (B, H, W) by whole cells: cell (i, j) gets what was at (i, j) + shift.

    Entering cells get the layer's value in `blank`, or 0. Up to eight layers may be masks.
    """
    masks = [name for name, layer in layers.items() if layer.dtype == torch.bool]
    names = [name for name in layers if name not in masks]
    # All masks move as the bits of one layer.
    values = [*(layers[name] for name in names), *([_as_bits([layers[name] for name in masks])] if masks else [])]
    blanks = [*(blank.get(name, 0.0) for name in names), *([0.0] if masks else [])]
    # Copying takes an eighth of the time of gathering, but has no gradient, and the host must know the shifts.
    copies = not torch.is_grad_enabled() and shift.shape[0] <= HOST_ENVIRONMENTS and is_readable(shift)
    values = moved(values, shift, blanks) if copies else _gathered(values, shift, blanks)
    others = _from_bits(values.pop(), len(masks)) if masks else []
    return dict(zip((*names, *masks), (*values, *others), strict=True))


def _gathered(layers: list[Tensor], shift: Tensor, blanks: list[float]) -> list[Tensor]:
    """Shift layers by gathering."""
    index, entering = sources(shift, *layers[0].shape[1:])
    values = [read(layer, index) for layer in layers]
    blanked = [torch.where(entering, blank, value) for value, blank in zip(values, blanks, strict=True)]
    return [value.to(layer.dtype) for value, layer in zip(blanked, layers, strict=True)]


def sources(shift: Int[Tensor, "B 2"], H: int, W: int) -> tuple[Int[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
    """Return the flat number of the cell that each cell gets its value from, any one where it enters, and where."""
    i = torch.arange(H, device=shift.device)[None, :, None] + shift[:, 0, None, None]
    j = torch.arange(W, device=shift.device)[None, None, :] + shift[:, 1, None, None]
    entering = (i < 0) | (i >= H) | (j < 0) | (j >= W)
    return i.clamp(0, H - 1) * W + j.clamp(0, W - 1), entering


def moved(layers: list[Tensor], shift: Tensor, blanks: list[float]) -> list[Tensor]:
    """Shift layers (B, H, W) by whole cells (B, 2), environment by environment; the host reads the shifts."""
    H, W = layers[0].shape[1:]
    # Padded where cells enter, and by as many less than nothing where they leave.
    rims = [(-j, j, -i, i) for i, j in ((max(-H, min(i, H)), max(-W, min(j, W))) for i, j in shift.tolist())]
    if len(rims) == 1:
        return [F.pad(layer, rims[0], value=blank) for layer, blank in zip(layers, blanks, strict=True)]
    return [
        torch.stack([F.pad(part, rim, value=blank) for part, rim in zip(layer, rims, strict=True)])
        for layer, blank in zip(layers, blanks, strict=True)
    ]


def _as_bits(masks: list[Tensor]) -> Tensor:
    """Return up to eight masks as the bits of one uint8."""
    return functools.reduce(torch.add, (mask.to(torch.int32) << k for k, mask in enumerate(masks))).to(torch.uint8)


def _from_bits(bits: Tensor, number: int) -> list[Tensor]:
    """Return the masks that `_as_bits` packed."""
    return [(bits.to(torch.int32) & (1 << k)) > 0 for k in range(number)]
