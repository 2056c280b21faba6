"""The windows of a robot as the arrays of a message, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.ops.moving import move_layers
from torchelev.site.fusion.windows import Contribution, Known, Windows, no_alignment
from torchelev.site.service.wire.messages import Layout, Message, MessageError, take_count

if TYPE_CHECKING:
    from jaxtyping import Float

MAX_SIDE, MAX_WINDOWS = 4096, 4096  # cells and windows of a message
_FARTHEST = 1 << 40  # cells
_LARGEST_HEIGHT, _LARGEST = 1e6, {"now": 1e11, "age": 1e11}  # [m], [m^2] and [s]
_LAYERS = "elevation", "variance", "age"


class Received(NamedTuple):
    """The windows of a message."""

    windows: Windows  #: times [s] are on the clock that the robots share
    offset: Float[Tensor, "B"]  #: [m] of the robot's last merge, NaN before the first


def sizes_of(windows: Windows) -> dict[str, Any]:
    """Return what the header says of the windows' sizes."""
    B, H, W = windows.known.elevation.shape
    return {"windows": B, "height": H, "width": W, "contributed": windows.contribution is not None}


def layout_of(header: Mapping[str, Any]) -> Layout:
    """Return the arrays of a message with this header; MessageError if its sizes are none."""
    B, H, W = (
        take_count(header, *size) for size in (("windows", MAX_WINDOWS), ("height", MAX_SIDE), ("width", MAX_SIDE))
    )
    contributed = header.get("contributed")
    if not (B and H and W) or not isinstance(contributed, bool):
        raise MessageError(f"message: must have windows of some cells, got {B} of {H} x {W}")
    cells, floats = (B, H, W), [*_LAYERS, "gradient_x", "gradient_y"]
    masks, numbers = ["is_known", "has_normal", "is_bounded", "is_new"], ["now", "rate", "offset"]
    corners = ["corner"]
    if contributed:
        floats += [f"was.{name}" for name in _LAYERS]
        masks.append("was.is_known")
        numbers += ["was.now", "was.rate", "was.offset"]
        corners.append("was.corner")
    rows: list[tuple[str, str, tuple[int, ...]]] = [(name, "float32", cells) for name in floats]
    rows += [(name, "bool", cells) for name in masks]
    rows += [(name, "float64", (B,)) for name in numbers]
    rows += [(name, "int64", (B, 2)) for name in corners]
    return [*rows, ("was.tilt", "float64", (B, 2))] if contributed else rows


def to_arrays(windows: Windows, offset: Float[Tensor, "B"]) -> dict[str, NDArray]:
    """Return windows as arrays. A cell has a height or an upper bound, so that one layer holds both.

    Args:
        windows: of the robot.
        offset: [m] of its last merge, NaN before the first.
    """
    known, was = windows.known, windows.contribution
    height = torch.where(windows.is_bounded, windows.upper_bound, known.elevation)
    values = known._replace(elevation=height)._asdict() | {"offset": offset}
    names = "gradient_x", "gradient_y", "has_normal", "is_bounded", "is_new"
    values |= {name: getattr(windows, name) for name in names}
    if was is not None:  # only what new cells replace is read
        before = was.known._asdict()
        shift = was.known.corner - known.corner
        used = _moved(windows.is_new, shift)
        before |= {name: torch.where(used, before[name], torch.zeros(())).float() for name in _LAYERS}
        before |= {"offset": was.alignment.offset, "tilt": was.alignment.tilt}
        values |= {f"was.{name}": value for name, value in before.items()}
    return {name: value.numpy() for name, value in values.items()}


def _moved(mask: Tensor, shift: Tensor) -> Tensor:
    H, W = mask.shape[1:]
    return move_layers({"mask": mask}, shift.clamp(-max(H, W), max(H, W)), {})["mask"]


def from_message(message: Message) -> Received:
    """Return the windows of a message; MessageError if a value is none that a map can have."""
    arrays = message.arrays(layout_of(message.header))
    _check(arrays)
    values = {name: torch.from_numpy(value) for name, value in arrays.items()}
    known, contribution = _known(values, ""), None
    if "was.now" in values:
        zero = torch.zeros(len(known.now), dtype=torch.int64)
        alignment = no_alignment(len(zero), zero.device)
        alignment = alignment._replace(offset=values["was.offset"], tilt=values["was.tilt"])
        contribution = Contribution(_known(values, "was."), alignment, zero, zero, zero - 1)
    surface = values["gradient_x"], values["gradient_y"], values["has_normal"]
    windows = Windows(known, *surface, known.elevation, values["is_bounded"], values["is_new"], contribution)
    return Received(windows, values["offset"])


def _known(values: Mapping[str, Tensor], prefix: str) -> Known:
    return Known(*(values[prefix + name] for name in Known._fields))


def _check(arrays: Mapping[str, NDArray]) -> None:
    """Raise MessageError unless all values are possible, so that no cell of the site is spoilt."""
    for name, values in arrays.items():
        kind, own = values.dtype.kind, name.removeprefix("was.")
        if kind == "f" and name != "offset" and not np.isfinite(values).all():
            raise MessageError(f"message: must hold finite numbers, got others in {name}")
        if own in ("variance", "rate") and (values < 0).any():
            raise MessageError(f"message: {name} must not be negative, got {values.min():g}")
        if kind == "i" and (np.abs(values) > _FARTHEST).any():
            raise MessageError(f"message: {name} must be cell numbers, got {values.max()}")
        if kind == "f" and (np.abs(values) > _LARGEST.get(own, _LARGEST_HEIGHT)).any():
            raise MessageError(f"message: {name} must be in metres or seconds, got {np.abs(values).max():g}")
    both = arrays["is_known"] & arrays["is_bounded"] | arrays["is_new"] & ~arrays["is_known"]
    if both.any():
        raise MessageError("message: cells must be known or bounded, got both, or new ones that are unknown")


def join(parts: list[Received]) -> Received:
    """Return the windows of several messages, which have the same size, as one."""
    if len(parts) == 1:
        return parts[0]
    contributions = [_contribution(part.windows) for part in parts]
    known = Known(*map(torch.cat, zip(*(part.windows.known for part in parts), strict=True)))
    names = Windows._fields[1:7]
    layers: dict[str, Any] = {name: torch.cat([getattr(part.windows, name) for part in parts]) for name in names}
    before = Known(*map(torch.cat, zip(*(each.known for each in contributions), strict=True)))
    alignment = no_alignment(len(known.now), known.now.device)
    alignment = alignment._replace(
        offset=torch.cat([each.alignment.offset for each in contributions]),
        tilt=torch.cat([each.alignment.tilt for each in contributions]),
    )
    zero = torch.zeros(len(known.now), dtype=torch.int64)
    contribution = Contribution(before, alignment, zero, zero, zero - 1)
    windows = parts[0].windows._replace(known=known, contribution=contribution, **layers)
    return Received(windows, torch.cat([part.offset for part in parts]))


def _contribution(windows: Windows) -> Contribution:
    """Return what robots contributed before, which may be nothing."""
    if windows.contribution is not None:
        return windows.contribution
    known, zero = windows.known, torch.zeros(len(windows.known.now), dtype=torch.int64)
    nothing = known._replace(is_known=torch.zeros_like(known.is_known))
    return Contribution(nothing, no_alignment(len(zero), zero.device), zero, zero, zero - 1)
