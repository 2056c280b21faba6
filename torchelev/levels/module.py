"""The levels of B maps as buffers of a module, which follow the maps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from torchelev.kernels.cpu_build import load
from torchelev.levels import native
from torchelev.levels.state import (
    SURFACE,
    Levels,
    LevelStatistics,
    blank_levels,
    forget_space,
    move,
    remove,
    rises,
    turn,
)
from torchelev.levels.step import update_levels
from torchelev.levels.views import View, view
from torchelev.stages.measure.stage import measure
from torchelev.state import MapState, blank_corner, fill, map_layers

if TYPE_CHECKING:
    from jaxtyping import Bool

    from torchelev.config import ElevationMapConfig
    from torchelev.inputs.update_inputs import Inputs


class MapLevels(nn.Module):
    """The surfaces of B maps besides the ground.

    Args:
        cfg: of the maps, with levels of more than one.
        num_envs: number of maps, B.
        device: device of the maps.
    """

    corner: Tensor
    lower: Tensor
    upper: Tensor
    free_top: Tensor
    is_open: Tensor

    def __init__(self, cfg: ElevationMapConfig, num_envs: int, device: torch.device | str) -> None:
        super().__init__()
        assert cfg.levels is not None
        self.cfg = cfg
        size = (num_envs, cfg.levels.others, cfg.grid.height, cfg.grid.width)
        self.register_buffer("corner", torch.tensor(blank_corner(cfg.grid), device=device).repeat(num_envs, 1))
        for name, value in blank_levels(size, device)._asdict().items():
            self.register_buffer(name, value)
        for name in LevelStatistics._fields:
            number = torch.zeros(num_envs, dtype=torch.int64, device=device)
            self.register_buffer(f"last_{name}", number, persistent=False)

    def build(self) -> None:
        """Build the C++ of these levels, if they run it."""
        if self.corner.is_cpu:
            load(*native.LIBRARY)

    @property
    def stored(self) -> Levels:
        """The buffers as one value, in rings. The next update overwrites them."""
        return Levels(*(cast("Tensor", getattr(self, name)) for name in Levels._fields))

    @property
    def statistics(self) -> LevelStatistics:
        """What the last update did, as fresh (B,) tensors."""
        return LevelStatistics(*(getattr(self, f"last_{name}").clone() for name in LevelStatistics._fields))

    @torch.no_grad()
    def sort_points(self, state: MapState, inputs: Inputs, recenter: Callable[[MapState, Inputs], None]) -> Inputs:
        """Take the points of other surfaces out of an update, and choose the ground; see `update_levels`.

        Args:
            state: of the maps before the update, which is recentred, in place.
            inputs: of the update.
            recenter: moves the windows of a state as the update will, in place.

        Returns:
            The inputs with `aside`.
        """
        if native.can_update(self.stored, state, self.cfg):
            recenter(state, inputs)
            aside, statistics = native.update_in_cpp(self.stored, self.corner, state, inputs, self.cfg)
        else:
            m = measure(*inputs, self.cfg.grid, self.cfg.sensor, state.elevation.dtype)
            recenter(state, inputs)
            step = update_levels(self.in_windows(state), state, m, self.cfg)
            map_layers(lambda old, new: old if new is old else old.copy_(new), state, step.state)
            self._write(step.levels, state.corner)
            aside, statistics = step.aside.view(inputs.points.shape[:3]), step.statistics
        for name, number in statistics._asdict().items():
            getattr(self, f"last_{name}").copy_(number)
        return inputs._replace(aside=aside)

    @torch.no_grad()
    def follow_drift(self, state: MapState) -> None:
        """Raise all surfaces as drift compensation raised the ground in an update."""
        if self.cfg.drift is not None:
            for name, step in rises(state.statistics.drift_correction.float()).items():
                getattr(self, name).add_(step)

    @torch.no_grad()
    def follow(self, state: MapState) -> None:
        """Follow windows that moved besides updates."""
        self._write(self.in_windows(state), state.corner)

    @torch.no_grad()
    def put(self, levels: Levels, state: MapState) -> None:
        """Replace the levels, given in the windows of the maps."""
        self._write(levels, state.corner)

    def in_windows(self, state: MapState) -> Levels:
        """Return the levels in the windows of a state of the maps, as `ElevationMap.forward` takes them."""
        return move(turn(self.stored, self.corner, to_ring=False), state.corner - self.corner)

    def _write(self, new: Levels, corner: Tensor) -> None:
        """Store levels of windows with this corner."""
        for stored, value in zip(self.stored, turn(new, corner, to_ring=True), strict=True):
            stored.copy_(value)
        self.corner.copy_(corner)

    @torch.no_grad()
    def forget(self, env_ids: Tensor | None, mask: Bool[Tensor, "B"] | None) -> None:
        """Forget the surfaces of some environments, or of all."""
        for name in SURFACE:
            fill(cast("Tensor", getattr(self, name)), 0.0, env_ids, mask)
        fill(self.free_top, -torch.inf, env_ids, mask)
        fill(self.is_open, False, env_ids, mask)

    @torch.no_grad()
    def forget_cells(self, state: MapState, cells: Bool[Tensor, "B H W"]) -> None:
        """Forget the surfaces of some cells of the maps."""
        levels = self.in_windows(state)
        levels = remove(levels, cells[:, None].expand(levels.lower.shape))
        self._write(forget_space(levels, cells), state.corner)

    def view(self, state: MapState, levels: Levels | None = None) -> View:
        """Return what is known of all surfaces: the ground of a state, and the others, None: the stored ones."""
        return view(self.in_windows(state) if levels is None else levels, state, self.cfg)
