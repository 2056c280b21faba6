"""The methods of a map that start it over, as a whole, around a place, or from what a site knows."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.channels.painted_map import PaintedMap
from torchelev.diagnosis.history import InputHistory
from torchelev.errors import require, require_positive
from torchelev.inputs import checks
from torchelev.maps.readable import ReadableMap
from torchelev.pipeline import rate, write
from torchelev.stages.disagreement.stage import add_disagreement, subtract_disagreement
from torchelev.stages.initialize import METHODS, Site, initialize
from torchelev.state import MapState, forget, forget_cells, map_layers

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class RestartableMap(PaintedMap, ReadableMap):
    """What starts an `ElevationMap` over, which has these attributes."""

    check_values: bool
    num_resets: Tensor
    _history: InputHistory

    def reset(self, env_ids: Int[Tensor, "K"] | None = None, *, mask: Bool[Tensor, "B"] | None = None) -> None:
        """Forget everything in all environments, in those of `env_ids`, or in those of `mask`.

        Args:
            env_ids: ids, int64, none twice.
            mask: True for the environments to forget; never makes the host wait for the device.

        Raises:
            TypeError: if an argument has the wrong type or dtype.
            ValueError: if an id is out of range or repeated, a shape or device is wrong, or both are given.
        """
        env_ids, mask = self._check_choice(env_ids, mask)
        self._derived.clear()
        self._history.forget(env_ids, mask)
        self.num_resets.add_(self._choose(env_ids, mask))
        with torch.no_grad():
            forget(self.state, self.cfg.grid, env_ids, mask)
        for part in (self.channels, self.levels):
            if part is not None:
                part.forget(env_ids, mask)

    def _check_choice(self, env_ids: Tensor | None, mask: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        require(env_ids is None or mask is None, "env_ids, mask", "exclude each other", "both", "give one of them")
        if mask is not None:
            mask = checks.check_mask("mask", mask, self.num_envs, self.device)
        if env_ids is not None:
            env_ids = checks.check_env_ids(env_ids, self.num_envs, self.device, self.check_values)
        return env_ids, mask

    def _choose(self, env_ids: Tensor | None, mask: Tensor | None) -> Bool[Tensor, "B"]:
        """Return which environments the ids or the mask choose; without both, all."""
        if mask is not None:
            return mask
        chosen = torch.zeros_like(self.num_resets, dtype=torch.bool)
        return chosen.fill_(True) if env_ids is None else chosen.index_fill_(0, env_ids, True)

    def initialize(self, feet: Float[Tensor, "B K 3"], method: str = "linear") -> None:
        """Estimate the unknown cells from ground points, such as the feet that a robot stands on.

        The cells get the maximum variance, so that their first measurement prevails.

        Args:
            feet: ground points, map frame [m].
            method: "linear" fills the convex hull of the feet, "nearest" the whole window.

        Raises:
            TypeError: if `feet` is no tensor of floats.
            ValueError: if the method is unknown, or `feet` has another shape or is not finite.
        """
        require(method in METHODS, "method", f"must be one of {', '.join(METHODS)}", repr(method), "use linear")
        feet = checks.check_feet(feet, self.num_envs, self.device, self.check_values)
        self._revise(lambda state: initialize(state, feet, method, self.cfg.grid, self.cfg.fusion.max_variance))

    def clear_around(self, center: Float[Tensor, "B 2"], radius: float) -> None:
        """Forget the cells around a place, such as where the robot was touched, carried, or saw itself.

        Args:
            center: x, y of each environment, map frame [m]; give float64 far from the origin.
            radius: cells whose centres lie within it are forgotten [m].

        Raises:
            TypeError: if `center` is no tensor of floats.
            ValueError: if a shape does not fit, or the radius is not positive and finite.
        """
        center = checks.check_center(center, self.num_envs, self.device, self.check_values)
        require_positive(radius=radius)
        away = self.cell_centers() - center[:, None, None].double()
        cells = torch.linalg.vector_norm(away, dim=-1) <= radius
        if self.levels is not None:
            self.levels.forget_cells(self.state, cells)
        self._revise(lambda state: forget_cells(state, cells))

    def _revise(self, change: Callable[[MapState], MapState]) -> None:
        """Change the heights besides updates, and rate the map again."""
        self._derived.clear()
        with torch.no_grad():
            state = change(subtract_disagreement(self.state))
            write(self.state, rate(add_disagreement(state), self.cfg, self._weights))
        self._sync_channels()

    def initialize_from(
        self,
        site: Site | str | Path,
        T_map_base: Float[Tensor, "B 4 4"] | None = None,
        *,
        env_ids: Int[Tensor, "K"] | None = None,
        mask: Bool[Tensor, "B"] | None = None,
    ) -> None:
        """Start with what a site knows: heights, their variances at their present age, and upper bounds; or a raster.

        Only unknown cells are filled, and what comes from the site does not count as measured when it is merged back.
        Heights of a raster do: a map that merges into a site takes them from there, see `SiteMap.import_raster`. They
        get the raster's variance, and the first measurement that contradicts one replaces it.
        A map with levels gets those of a site with levels, and chooses its ground by its first update with T_map_base.
        Heights are the site's; those of a robot that has merged since its last `reset` are raised by its offset.

        Args:
            site: a `torchelev.site.SiteMap` of the same resolution; a `torchelev.io.rasters.Raster`; or the path of a
                file that `Raster.open` takes as it is, in the map frame.
            T_map_base: poses of the robots, on which their windows are centred first, (B, 4, 4). None: they stay.
            env_ids: environments to fill, int64, none twice; None: all.
            mask: True for the environments to fill, in place of `env_ids`.

        Raises:
            TypeError: if an argument has the wrong type or dtype.
            ValueError: if the site has another resolution, an id is out of range or repeated, a shape or device is
                wrong, or both ids and a mask are given; or as of `Raster.open`. Nothing has changed then.
        """
        source = _open(site)
        if T_map_base is not None:
            shape = (self.num_envs, 4, 4)
            T_map_base = checks.check_pose("T_map_base", T_map_base, shape, self.device, self.check_values)
        chosen = self._choose(*self._check_choice(env_ids, mask))
        self._derived.clear()
        with torch.no_grad():
            before = map_layers(Tensor.clone, self.state)
            write(self.state, subtract_disagreement(self.state))
            try:
                state = source.fill_state(self, T_map_base, chosen)
            except BaseException:
                write(self.state, before)
                raise
            write(self.state, rate(add_disagreement(state), self.cfg, self._weights))
        self._sync_channels()


def _open(site: Site | str | Path) -> Site:
    """Return what fills maps, of a path the raster; TypeError for anything else, as for the folder of a site."""
    if isinstance(site, (str, Path)) and (Path(site).suffix or Path(site, "metadata.yaml").exists()):
        opened: Site = importlib.import_module("torchelev.io.rasters").Raster.open(site)  # files stand above maps
        return opened
    hint = "give one, a Raster, or the path of a .tif, an .npz or a bag"
    require(hasattr(site, "fill_state"), "site", "must be a SiteMap", type(site).__name__, hint, TypeError)
    return site  # type: ignore[return-value]
