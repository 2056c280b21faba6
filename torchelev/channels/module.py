"""The channels of B maps as buffers of a module, which follow the maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from torchelev.channels import fuse
from torchelev.channels.config import ChannelConfig
from torchelev.channels.native import can_update, update_in_cpp
from torchelev.channels.points import match_points
from torchelev.channels.state import Channel, Ground, blank_channel, follow, known_elevation, read_cells
from torchelev.grid import GridConfig
from torchelev.ops.moving import move_layers
from torchelev.state import MapState, blank_corner, fill

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.inputs.update_inputs import Inputs
    from torchelev.stages.measure.config import SensorConfig


class Channels(nn.Module):
    """What B maps hold of each cell besides its height.

    Args:
        cfg: settings by name.
        grid: the windows of the maps.
        sensor: noise and range of points.
        num_envs: number of maps, B.
        device: device of the maps.
    """

    corner: Tensor
    height: Tensor

    def __init__(
        self,
        cfg: Mapping[str, ChannelConfig],
        grid: GridConfig,
        sensor: SensorConfig,
        num_envs: int,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        self.cfg, self.grid, self.sensor = cfg, grid, sensor
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
    def follow(self, state: MapState) -> None:
        """Follow a change of the maps besides an update, such as cells that were forgotten."""
        self._change(state, None, None, None, {})

    @torch.no_grad()
    def update(
        self,
        state: MapState,
        dt: Float[Tensor, "B"],
        inputs: Inputs,
        own: Bool[Tensor, "B S N"] | None,
        features: Mapping[str, Float[Tensor, "B M C"]],
    ) -> None:
        """Follow an update of the maps, and fuse what its points bring.

        Args:
            state: of the maps after it.
            dt: time since the last update [s], finite and not negative.
            inputs: of the update.
            own: points on the robot's links, for C++; those in its box are found here.
            features: values of the points by channel.
        """
        self._change(state, dt, inputs, own, features)

    def _change(
        self,
        state: MapState,
        dt: Tensor | None,
        inputs: Inputs | None,
        own: Tensor | None,
        features: Mapping[str, Tensor],
    ) -> None:
        """Do the work of `follow`, with None for dt and inputs, and of `update`."""
        channels = {name: self.channel(name) for name in self.cfg}
        if can_update(channels, state, self.sensor):
            ground = Ground(self.corner, self.height)
            given = (self.grid, self.sensor, dt, inputs, own, features)
            update_in_cpp(channels, self.cfg, ground, state, *given)
            return
        ground_points = None
        if inputs is not None and features:
            ground_points = match_points(inputs, state, self.grid, self.sensor)
        for name in channels:
            cfg, size = self.cfg[name], (self.grid.height, self.grid.width)
            new = self._followed(name, state, dt)
            if ground_points is not None and name in features:
                added, total = fuse.accumulate(features[name], ground_points, self.grid.num_cells, cfg)
                new = fuse.combine(new, added.unflatten(1, size), total.unflatten(1, size), cfg)
            self.write(name, new)
        self.corner.copy_(state.corner)
        self.height.copy_(known_elevation(state))

    def _followed(self, name: str, state: MapState, dt: Tensor | None) -> Channel:
        """Return a channel that has followed the maps to a state; dt is None besides updates."""
        largest = max(self.grid.height, self.grid.width)
        shift = (state.corner - self.corner).clamp(-largest, largest)
        height = move_layers({"height": self.height}, shift, {"height": torch.nan})["height"]
        if dt is not None:
            height = height + state.statistics.drift_correction.float()[:, None, None]
        elapsed = height.new_zeros(len(height)) if dt is None else dt.float()
        ground = Ground(state.corner, height)
        return follow(self.channel(name), ground, known_elevation(state), shift, elapsed, self.cfg[name])

    def write(self, name: str, new: Channel) -> None:
        """Copy a channel into the buffers."""
        for stored, value in zip(self.channel(name), new, strict=True):
            if stored is not None and value is not None:
                stored.copy_(value)

    @torch.no_grad()
    def forget(self, env_ids: Tensor | None, mask: Bool[Tensor, "B"] | None) -> None:
        """Forget all channels of some environments, or of all."""
        for name in self.cfg:
            for part in self.channel(name):
                if part is not None:
                    fill(part, 0, env_ids, mask)

    @property
    def layers(self) -> tuple[str, ...]:
        """The names of all components, each a layer of the map."""
        return tuple(layer for name, cfg in self.cfg.items() for layer in cfg.components(name))

    def read(
        self, name: str, state: MapState | None, cell: Int[Tensor, "B M"] | None = None
    ) -> tuple[Float[Tensor, "B *cells C"], Bool[Tensor, "B *cells"]]:
        """Return the values of a channel, and where it has them: of the maps, or as these cells of another state.

        Args:
            name: of the channel.
            state: of the maps; None: the last one that was followed.
            cell: flat numbers of the cells to read; None: all, as (B, H, W).
        """
        channel = self.channel(name) if state is None else self._followed(name, state, None)
        return fuse.read(channel if cell is None else read_cells(channel, cell), self.cfg[name])
