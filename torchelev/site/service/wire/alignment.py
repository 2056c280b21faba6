"""How a robot's windows were aligned, as an acknowledgement of its message says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from torchelev.errors import require
from torchelev.site.fusion.windows import Alignment


def write_alignment(alignment: Alignment, own: slice) -> dict[str, Any]:
    """Return the alignment of a robot's own windows as fields of a header."""
    offset, tilt, is_isolated = (value[own].tolist() for value in alignment)
    return {"offset": offset, "tilt": tilt, "isolated": is_isolated}


def read_alignment(header: Mapping[str, Any], size: int) -> Alignment:
    """Return the alignment of `size` windows from a header; ValueError if it is of others."""
    offset = torch.tensor(header["offset"], dtype=torch.float64)
    tilt = torch.tensor(header["tilt"], dtype=torch.float64)
    is_isolated = torch.tensor(header["isolated"], dtype=torch.bool)
    fits = offset.shape == is_isolated.shape == (size,) and tilt.shape == (size, 2)
    require(fits, "message", f"must give the offsets of {size} windows", tuple(offset.shape), "is it damaged?")
    return Alignment(offset, tilt, is_isolated)
