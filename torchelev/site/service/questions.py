"""Questions about areas of a site, to plan on, to show or to start from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.site.service.wire.messages import MAX_ARRAYS, MessageError, decode, encode

if TYPE_CHECKING:
    from torchelev.site.service.server.served_site import ServedSite


class Areas(NamedTuple):
    """Areas of a site."""

    layers: dict[str, NDArray[np.float32]]  #: (B, H, W), NaN where unknown
    about: dict[str, Any]  #: site, version, time [s], resolution [m], rate [m^2/s] and extent [m]


def ask_areas(corner: Sequence[Sequence[int]], height: int, width: int, layers: Sequence[str]) -> bytes:
    """Return the question for B areas whose first cells have these numbers on the lattice; B may be 0."""
    header = {"kind": "areas", "corner": [[int(k) for k in cell] for cell in corner], "layers": list(layers)}
    return encode(header | {"height": height, "width": width})


def answer_question(site: ServedSite, payload: bytes) -> bytes:
    """Return the answer to a question about a site, or the reason why there is none."""
    try:
        header = decode(payload).header
        corner, size, names = _read(header)
        areas = site.windows(torch.tensor(corner), *size, names) if corner and names else {}
        layout = [(name, "float32", (len(corner), *size)) for name in areas]
        found = {name: value.cpu().numpy() for name, value in areas.items()}
        own = {"kind": "areas", "layers": list(areas), "windows": len(corner), "height": size[0], "width": size[1]}
        return encode(own | describe(site), layout, found)
    except (MessageError, KeyError, ValueError, TypeError, OSError) as error:
        text = error.args[0] if isinstance(error, KeyError) else error
        return encode({"kind": "refused", "text": " ".join(str(text).split())})


def describe(site: ServedSite) -> dict[str, Any]:
    """Return what an answer says of the site as a whole."""
    return {
        "site": site.id,
        "version": site.version,
        "time": site.time,
        "resolution": site.resolution,
        "rate": site.rate,
        "extent": site.extent,
    }


def _read(header: Mapping[str, Any]) -> tuple[list[list[int]], tuple[int, int], list[str]]:
    """Return corners, size and layers of a question; MessageError if it is not a question, or asks for too much."""
    corner, names, sides = header.get("corner"), header.get("layers"), (header.get("height"), header.get("width"))
    are_cells = isinstance(corner, list) and all(
        isinstance(cell, list) and len(cell) == 2 and all(type(k) is int and abs(k) < 1 << 40 for k in cell)
        for cell in corner
    )
    is_size = all(type(side) is int and 0 < side <= 1 << 16 for side in sides)
    are_names = isinstance(names, list) and len(names) < 1000 and all(isinstance(name, str) for name in names)
    if not (header.get("kind") == "areas" and are_cells and is_size and are_names):
        raise MessageError("message: must ask for areas, got something else")
    total = 4 * len(corner) * sides[0] * sides[1] * len(names)  # type: ignore[arg-type, operator]
    if total > MAX_ARRAYS:
        raise MessageError(f"area: must be at most {MAX_ARRAYS >> 20} MiB, got {total >> 20}; ask for less at a time")
    return corner, sides, names  # type: ignore[return-value]


def read_answer(payload: bytes) -> Areas:
    """Return the areas of an answer; ValueError with the merger's reason if there are none."""
    message = decode(payload)
    header = message.header
    if header.get("kind") == "refused":
        raise ValueError(str(header.get("text")))
    names, size = header["layers"], (header["windows"], header["height"], header["width"])
    arrays = message.arrays([(name, "float32", size) for name in names])
    return Areas(arrays, {name: header[name] for name in ("site", "version", "time", "resolution", "rate", "extent")})
