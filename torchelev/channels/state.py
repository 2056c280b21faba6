"""What channels hold, and how it follows the ground of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.channels.config import ChannelConfig
from torchelev.ops.moving import sources
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float, Int


class Channel(NamedTuple):
    """One channel of B maps. Values count where the weight is positive."""

    values: Float[Tensor, "B H W C"]  #: as `ChannelConfig.kind` says; of "class" the counts a_c
    weight: Float[Tensor, "B H W"]  #: W, the evidence
    age: Float[Tensor, "B H W"] | None  #: [s] since the cell was last seen; None without a `max_age`


class Ground(NamedTuple):
    """The ground that channels belong to."""

    corner: Int[Tensor, "B 2"]  #: of the window, as in `MapState`
    height: Float[Tensor, "B H W"]  #: [m] elevation at the last update; NaN where it was not known


def blank_channel(cfg: ChannelConfig, size: tuple[int, int, int], device: torch.device | str) -> Channel:
    """Return a channel of which nothing is known; `size` is (B, H, W)."""
    weight = torch.zeros(size, device=device)
    values = torch.zeros(*size, cfg.size, device=device, dtype=getattr(torch, cfg.dtype))
    return Channel(values, weight, None if cfg.max_age is None else weight.clone())


def follow(
    channel: Channel,
    ground: Ground,
    elevation: Float[Tensor, "B H W"],
    shift: Int[Tensor, "B 2"],
    dt: Float[Tensor, "B"],
    cfg: ChannelConfig,
) -> Channel:
    """Return a channel moved with the window, aged, and without the cells whose ground is another one.

    Args:
        channel: the channel before.
        ground: that it belongs to, moved with the window.
        elevation: of the map now [m], NaN where it is not known.
        shift: cells by which the window moved.
        dt: time since the last update [s].
        cfg: its settings.
    """
    moved = move_channel(channel, shift)
    is_same = (elevation - ground.height).abs() <= cfg.tolerance  # False where either is NaN
    weight, values, age = moved.weight, moved.values, moved.age
    if cfg.half_life is not None:
        share = torch.exp2(-dt / cfg.half_life)[:, None, None]
        weight = weight * share
        values = values * share[..., None].to(values.dtype) if cfg.kind == "class" else values
    if age is not None and cfg.max_age is not None:
        age = torch.where(weight > 0, age + dt[:, None, None], 0.0)
        is_same = is_same & (age <= cfg.max_age)
    return Channel(
        torch.where(is_same[..., None], values, 0.0),
        torch.where(is_same, weight, 0.0),
        None if age is None else torch.where(is_same, age, 0.0),
    )


def move_channel(channel: Channel, shift: Int[Tensor, "B 2"]) -> Channel:
    """Return a channel whose window moved by whole cells; entering cells are blank."""
    place, entering = sources(shift, *channel.weight.shape[1:])
    place = place.flatten(1)

    def moved(values: Tensor) -> Tensor:
        given = values.flatten(1, 2) if values.ndim == 4 else values.flatten(1)[..., None]
        found = given.gather(1, place[..., None].expand(-1, -1, given.shape[-1])).view(values.shape)
        return torch.where(entering[..., None] if values.ndim == 4 else entering, 0.0, found)

    age = None if channel.age is None else moved(channel.age)
    return Channel(moved(channel.values), moved(channel.weight), age)


def read_cells(channel: Channel, cell: Int[Tensor, "B M"]) -> Channel:
    """Return a channel of the cells with these flat numbers: values (B, M, C) and weight (B, M), without an age."""
    values, weight = channel.values.flatten(1, 2), channel.weight.flatten(1)
    found = values.gather(1, cell[..., None].expand(-1, -1, values.shape[-1]))
    return Channel(found, weight.gather(1, cell), None)


def known_elevation(state: MapState) -> Float[Tensor, "B H W"]:
    """Return the elevation [m] in float32, NaN where it is not known."""
    return torch.where(state.validity, state.elevation, torch.nan).float()
