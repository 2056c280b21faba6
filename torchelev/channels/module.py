"""The channels of B maps as buffers of a module, which follow the maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from torchelev.channels import fuse
from torchelev.channels.config import ChannelConfigs
from torchelev.channels.native import can_update, update_in_cpp
from torchelev.channels.points import find_speakers, floats_of
from torchelev.channels.state import Channel, Ground, blank_channel, follow
from torchelev.grid import GridConfig
from torchelev.ops.moving import move_layers
from torchelev.state import MapState, blank_corner

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.inputs.update_inputs import Inputs


class Channels(nn.Module):
    """What B maps hold of each cell besides its height.

    Args:
        cfg: settings by name.
        grid: the windows of the maps.
        num_envs: number of maps, B.
        device: device of the maps.
    """

    corner: Tensor
    height: Tensor

    def __init__(self, cfg: ChannelConfigs, grid: GridConfig, num_envs: int, device: torch.device | str) -> None:
        super().__init__()
        self.cfg, self.grid = cfg, grid
        size = (num_envs, grid.height, grid.width)
        self.register_buffer("corner", torch.tensor(blank_corner(grid), device=device).repeat(num_envs, 1))
        self.register_buffer("height", torch.full(size, torch.nan, device=device))
        for name, settings in cfg.items():
            for part, value in blank_channel(settings, size, device)._asdict().items():
                self.register_buffer(f"{name}_{part}", value)

    def channel(self, name: str) -> Channel:
        """Return the buffers of a channel."""
        return Channel(*(cast("Tensor", getattr(self, f"{name}_{part}")) for part in Channel._fields))

    @torch.no_grad()
    def update(
        self,
        state: MapState,
        dt: Float[Tensor, "B"] | None = None,
        inputs: Inputs | None = None,
        features: dict[str, Float[Tensor, "B M C"]] | None = None,
        noise: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        """Follow the maps, and fuse what points bring.

        Args:
            state: of the maps, after an update or another change.
            dt: time since the last call [s]; None: no time has passed, and the maps did not drift.
            inputs: of the update.
            features: values of its points by channel.
            noise: see `find_speakers`.
        """
        channels = {name: self.channel(name) for name in self.cfg}
        ground, brought = Ground(self.corner, self.height), features or {}
        if can_update(channels, state):
            update_in_cpp(channels, self.cfg, ground, state, self.grid, dt, inputs, brought, noise)
        else:
            self._update_by_tensors(channels, state, dt, inputs, brought, noise)

    def _update_by_tensors(
        self,
        channels: dict[str, Channel],
        state: MapState,
        dt: Tensor | None,
        inputs: Inputs | None,
        features: dict[str, Tensor],
        noise: tuple[float, float],
    ) -> None:
        """Do the same by tensors: the definition."""
        ground, shift, elapsed = self._move_ground(state, dt)
        elevation, size = floats_of(state), (self.grid.height, self.grid.width)
        speakers = find_speakers(inputs, state, self.grid, noise) if features and inputs is not None else None
        for name, channel in channels.items():
            cfg = self.cfg[name]
            new = follow(channel, ground, elevation, shift, elapsed, cfg)
            if speakers is not None and name in features:
                added, total = fuse.accumulate(features[name], speakers, self.grid.num_cells, cfg)
                new = fuse.combine(new, added.unflatten(1, size), total.unflatten(1, size), cfg)
            self.write(name, new)
        self.corner.copy_(state.corner)
        self.height.copy_(elevation)

    def write(self, name: str, new: Channel) -> None:
        """Copy a channel into the buffers."""
        for stored, value in zip(self.channel(name), new, strict=True):
            if stored is not None and value is not None:
                stored.copy_(value)

    def _move_ground(self, state: MapState, dt: Tensor | None) -> tuple[Ground, Tensor, Tensor]:
        """Return the ground that channels belong to in the map's window, by how many cells that moved, and dt."""
        largest = max(self.grid.height, self.grid.width)
        shift = (state.corner - self.corner).clamp(-largest, largest)
        height = move_layers({"height": self.height}, shift, {"height": torch.nan})["height"]
        if dt is None:
            return Ground(state.corner, height), shift, height.new_zeros(len(height))
        height = height + state.statistics.drift_correction.float()[:, None, None]
        return Ground(state.corner, height), shift, dt.float()

    @torch.no_grad()
    def forget(self, env_ids: Tensor | None, mask: Bool[Tensor, "B"] | None) -> None:
        """Forget all channels of some environments, or of all."""
        for name in self.cfg:
            for part in self.channel(name):
                if part is not None and env_ids is not None:
                    part.index_fill_(0, env_ids, 0)
                elif part is not None and mask is not None:
                    part.masked_fill_(mask.view(-1, *[1] * (part.ndim - 1)), 0)
                elif part is not None:
                    part.zero_()

    @property
    def layers(self) -> tuple[str, ...]:
        """The names of all components, each a layer of the map."""
        return tuple(layer for name, cfg in self.cfg.items() for layer in cfg.components(name))

    def read(self, name: str, state: MapState) -> tuple[Float[Tensor, "B H W C"], Bool[Tensor, "B H W"]]:
        """Return the values of a channel, and where the map has them."""
        values, known = fuse.read(self.channel(name), self.cfg[name])
        return values, known & state.validity
