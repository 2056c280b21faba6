"""The open filter of the paper: a small convolutional net on the elevation, for comparison.

Its weights are fixed to cells of 4 cm and come from a file that the user gives.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchelev.errors import message, require
from torchelev.layers import Layer
from torchelev.ops.windows import shifted

if TYPE_CHECKING:
    from jaxtyping import Float

DILATIONS = (1, 2, 3)
RIM = max(DILATIONS)  # [cells] that the windows reach
SHAPES = {f"conv{d}.weight": (4, 1, 3, 3) for d in DILATIONS} | {"conv_final.weight": (1, 12, 1, 1)}


class PaperFilter(nn.Module):
    """Rates heights by exp(-w . |f * z|): twelve 3 x 3 filters f, four at each dilation of 1, 2 and 3 cells.

    Traversability is 1 where no filter answers, as on the flat, and can exceed 1 if some w are negative. Filters
    whose entries sum to 0 do not depend on altitude.
    """

    def __init__(self) -> None:
        super().__init__()
        self.banks = nn.ParameterList(nn.Parameter(torch.randn(4, 1, 3, 3) / 3) for _ in DILATIONS)
        self.final = nn.Parameter(torch.rand(1, 12, 1, 1))

    @classmethod
    def from_npz(cls, path: str | Path) -> PaperFilter:
        """Read conv1.weight, conv2.weight, conv3.weight (4, 1, 3, 3) and conv_final.weight (1, 12, 1, 1).

        Raises FileNotFoundError without the file, ValueError for another file and for weights that are missing, of
        other shapes or not finite.
        """
        weights = _read(Path(path))
        net = cls()
        with torch.no_grad():
            for parameter, name in zip((*net.banks, net.final), SHAPES, strict=True):
                parameter.copy_(weights[name])
        return net

    def forward(self, elevation: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
        """Rate finite heights [m]; 0 within 3 cells of the map's rim, where the windows leave it."""
        H, W = elevation.shape[1:]
        if min(H, W) <= 2 * RIM:
            return torch.zeros_like(elevation)
        z = elevation[:, None]
        banks = zip(DILATIONS, self.banks, strict=True)
        seen = [F.conv2d(shifted(z, RIM - d), weight.to(z.dtype), dilation=d) for d, weight in banks]
        rated = torch.exp(-F.conv2d(torch.cat(seen, 1).abs(), self.final.to(z.dtype)))
        return F.pad(rated[:, 0], [RIM] * 4)

    def rate(self, layer: Layer) -> Layer:
        """Rate a layer of heights [m]: known where all of a cell's 7 x 7 neighbours are, else 0."""
        values, known = layer
        unknown = F.pad((~known).to(values.dtype), [RIM] * 4, value=1.0)
        rated = F.max_pool2d(unknown[:, None], 2 * RIM + 1, 1)[:, 0] == 0
        return torch.where(rated, self(torch.where(known, values, 0.0)), 0.0), rated


def _read(path: Path) -> dict[str, Tensor]:
    hint = f"give an .npz with {', '.join(SHAPES)}"
    require(path.exists(), str(path), "must be a file of weights", "no file", hint, FileNotFoundError)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in SHAPES if name in arrays}
    except (ValueError, OSError, zipfile.BadZipFile, AttributeError, TypeError) as error:
        raise ValueError(message(str(path), "must be a file of weights", type(error).__name__, hint)) from error
    for name, shape in SHAPES.items():
        array = found.get(name)
        actual = "none" if array is None else f"{array.shape} {array.dtype}"
        fits = array is not None and array.shape == shape and array.dtype.kind == "f" and bool(np.isfinite(array).all())
        require(fits, f"{path}, {name}", f"must be {shape} finite floats", actual, hint)
    return {name: torch.from_numpy(array) for name, array in found.items()}
