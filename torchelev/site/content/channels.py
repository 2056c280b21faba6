"""The channels that a site keeps: their layers in its tiles, and how they are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.channels import fuse
from torchelev.channels.config import parse_channels
from torchelev.channels.state import Channel
from torchelev.errors import require

if TYPE_CHECKING:
    from jaxtyping import Float

    from torchelev.elevation_map import ElevationMap


class SiteChannels:
    """The channels of a site, by name; each is stored as its components, their weight, and since when they hold.

    Args:
        channels: as of `ElevationMapConfig`, or from `attributes`.
        taken: layers that the site has already.
        stored: layers of an existing site, which may lack those of `since`; None: a new site, which gets all.

    Raises:
        TypeError, ValueError: as of `ElevationMapConfig(channels=...)`.
    """

    def __init__(
        self, channels: Mapping[str, Any] | None, taken: tuple[str, ...], stored: tuple[str, ...] | None = None
    ) -> None:
        self.configs = parse_channels({} if channels is None else channels, taken)
        layers = [layer for name in self.configs for layer in (*self.sources(name), self.since(name))]
        #: The layers in the tiles.
        self.stored = tuple(layer for layer in layers if layer and (stored is None or layer in stored))

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self.configs)

    @property
    def attributes(self) -> dict[str, Any]:
        """The settings as JSON values."""
        return {name: {**asdict(cfg), "names": list(cfg.names)} for name, cfg in self.configs.items()}

    @property
    def layers(self) -> tuple[str, ...]:
        """The components of all channels, as they are read."""
        return tuple(layer for name, cfg in self.configs.items() for layer in cfg.components(name))

    def sources(self, channel: str) -> tuple[str, ...]:
        """Return the layers in the tiles that a channel is read from: its components, followed by its weight."""
        return (*self.configs[channel].components(channel), f"{channel}/weight")

    def since(self, channel: str) -> str | None:
        """Return the layer in the tiles that dates the evidence of a cell; None for a maximum, which needs no date.

        "exponential" and "class_average": the time at which the value was measured [s], by the site's clock. Others:
        the number of the merge at which the cell's evidence began, which is exact up to 2^24 merges.
        """
        cfg = self.configs[channel]
        if cfg.kind == "maximum":
            return None
        return f"{channel}/time" if cfg.is_newest else f"{channel}/merge"

    def channel_of(self, layer: str) -> str:
        """Return the channel of a component."""
        return layer.split(".")[0]

    def compute(self, layer: str, stored: Mapping[str, Tensor]) -> Float[Tensor, "..."]:
        """Return a component as it is read, NaN where unknown."""
        name = self.channel_of(layer)
        *parts, weight = (stored[source] for source in self.sources(name))
        cfg = self.configs[name]
        values, known = fuse.read(Channel(torch.stack(parts, -1), weight, None), cfg)
        return torch.where(known, values[..., cfg.components(name).index(layer)], torch.nan)

    def require_fit(self, emap: ElevationMap) -> None:
        """Raise ValueError if a map has one of the channels with another kind or other components."""
        for name, cfg in self.configs.items():
            own = emap.cfg.channels.get(name, cfg)
            fits = (own.kind, own.components(name)) == (cfg.kind, cfg.components(name))
            rule = f"must be of kind {cfg.kind} with {', '.join(cfg.components(name))}, as of the site"
            actual = f"{own.kind} with {', '.join(own.components(name))}"
            require(fits, f"emap.cfg.channels[{name!r}]", rule, actual, "rename it")
