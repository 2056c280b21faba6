"""The traversability filter of the paper's open code: a small convolutional net on the elevation, for comparison.

It is trained for cells of 4 cm. Its weights are not part of torchelev: read them from a file with `from_npz`.
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

_DILATIONS = (1, 2, 3)  # [cells]
RIM = max(_DILATIONS)  # [cells] radius of the largest window
SHAPES = {f"conv{d}.weight": (4, 1, 3, 3) for d in _DILATIONS} | {"conv_final.weight": (1, 12, 1, 1)}


class PaperFilter(nn.Module):
    """Rates heights z by exp(-w . |f * z|), with twelve 3 x 3 filters f: four each at dilations of 1, 2 and 3 cells.

    Traversability is 1 where no filter responds, as on flat ground if the entries of each filter sum to 0, and can
    exceed 1 if some weights w are negative.
    """

    def __init__(self) -> None:
        super().__init__()
        self.banks = nn.ParameterList(nn.Parameter(torch.randn(4, 1, 3, 3) / 3) for _ in _DILATIONS)
        self.final = nn.Parameter(torch.rand(1, 12, 1, 1))

    @classmethod
    def from_npz(cls, path: str | Path) -> PaperFilter:
        """Read the weights from a file.

        Args:
            path: an .npz with conv1.weight, conv2.weight and conv3.weight (4, 1, 3, 3), and conv_final.weight
                (1, 12, 1, 1).

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no .npz, or weights are missing, of other shapes or not finite.
        """
        weights = _read_weights(Path(path))
        net = cls()
        with torch.no_grad():
            for parameter, name in zip((*net.banks, net.final), SHAPES, strict=True):
                parameter.copy_(weights[name])
        return net

    def forward(self, elevation: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
        """Rate finite heights [m]; 0 within 3 cells of the border, where windows reach beyond the map."""
        H, W = elevation.shape[1:]
        if min(H, W) <= 2 * RIM:
            return torch.zeros_like(elevation)
        z = elevation[:, None]
        banks = zip(_DILATIONS, self.banks, strict=True)
        responses = [F.conv2d(shifted(z, RIM - d), weight.to(z.dtype), dilation=d) for d, weight in banks]
        rated = torch.exp(-F.conv2d(torch.cat(responses, 1).abs(), self.final.to(z.dtype)))
        return F.pad(rated[:, 0], [RIM] * 4)

    def rate(self, layer: Layer) -> Layer:
        """Rate a layer of heights [m]; known where the whole 7 x 7 window is, 0 elsewhere."""
        values, known = layer
        unknown = F.pad((~known).to(values.dtype), [RIM] * 4, value=1.0)
        rated = F.max_pool2d(unknown[:, None], 2 * RIM + 1, 1)[:, 0] == 0
        return torch.where(rated, self(torch.where(known, values, 0.0)), 0.0), rated


def _read_weights(path: Path) -> dict[str, Tensor]:
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
