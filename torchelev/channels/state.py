"""What channels hold, and how it follows the ground of the map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.channels.config import ChannelConfig
from torchelev.ops.moving import move_layers

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
    parts: Mapping[str, Tensor] = {str(k): part for k, part in enumerate(channel.values.unbind(-1))}
    rest = {"weight": channel.weight} | ({} if channel.age is None else {"age": channel.age})
    moved = move_layers(dict(parts) | rest, shift, {})
    values = torch.stack([moved[name] for name in parts], -1)
    return Channel(values, moved["weight"], moved.get("age"))
