"""The levels of B maps as buffers of a module, which follow the maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from torchelev.levels.compiled import StoredLevels
from torchelev.levels.state import (
    SURFACE,
    Levels,
    LevelStatistics,
    blank_levels,
    forget_space,
    move,
    raise_surfaces,
    remove,
    turn,
)
from torchelev.levels.step import update_levels
from torchelev.levels.views import View, view
from torchelev.stages.measure.stage import measure
from torchelev.stages.recenter.stage import recenter
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
    last_numbers: Tensor

    def __init__(self, cfg: ElevationMapConfig, num_envs: int, device: torch.device | str) -> None:
        super().__init__()
        assert cfg.levels is not None
        self.cfg = cfg
        size = (num_envs, cfg.levels.others, cfg.grid.height, cfg.grid.width)
        self.register_buffer("corner", torch.tensor(blank_corner(cfg.grid), device=device).repeat(num_envs, 1))
        for name, value in blank_levels(size, device)._asdict().items():
            self.register_buffer(name, value)
        numbers = torch.zeros(num_envs, len(LevelStatistics._fields), dtype=torch.int64, device=device)
        self.register_buffer("last_numbers", numbers, persistent=False)

    @property
    def stored(self) -> Levels:
        """The buffers as one value, in rings. The next update overwrites them."""
        return Levels(*(cast("Tensor", getattr(self, name)) for name in Levels._fields))

    @property
    def statistics(self) -> LevelStatistics:
        """What the last update did, as fresh (B,) tensors."""
        return LevelStatistics(*self.last_numbers.clone().unbind(1))

    @property
    def why_tensors(self) -> str:
        """Why no compiled code takes these buffers, in a clause; empty where it does."""
        is_plain = all(value.is_contiguous() for value in self.stored) and self.lower.dtype == torch.float32
        return "" if is_plain else "the levels are not contiguous float32; load the map by load_state"

    @property
    def compiled(self) -> StoredLevels:
        """The buffers as compiled code updates them, in place."""
        return StoredLevels(self.corner, *self.stored, self.last_numbers)

    @torch.no_grad()
    def sort_points(self, state: MapState, inputs: Inputs) -> Inputs:
        """Take the points of other surfaces out of an update, and choose the ground, by tensors; see `update_levels`.

        Args:
            state: of the maps before the update, which is recentred, in place.
            inputs: of the update.

        Returns:
            The inputs with `aside`.
        """
        m = measure(*inputs, self.cfg.grid, self.cfg.sensor, state.elevation.dtype)
        moved = recenter(state, m, self.cfg.grid)
        step = update_levels(move(self._in_rows(), moved.corner - self.corner), moved, m, self.cfg)
        map_layers(lambda old, new: old if new is old else old.copy_(new), state, step.state)
        self._write(step.levels, state.corner)
        self.last_numbers.copy_(torch.stack(step.statistics, 1))
        return inputs._replace(aside=step.aside.view(inputs.points.shape[:3]))

    @torch.no_grad()
    def follow_drift(self, state: MapState) -> None:
        """Raise all surfaces as drift compensation raised the ground in an update."""
        if self.cfg.drift is not None:
            raised = raise_surfaces(self.stored, state.statistics.drift_correction.to(self.lower.dtype))
            for name in ("lower", "upper", "free_top"):
                getattr(self, name).copy_(getattr(raised, name))

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
        return move(self._in_rows(), state.corner - self.corner)

    def _in_rows(self) -> Levels:
        """Return the levels in the windows that they were stored in."""
        return turn(self.stored, self.corner, to_ring=False)

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
