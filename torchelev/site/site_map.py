"""`SiteMap`: the class that users call."""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.grid import GridConfig
from torchelev.inputs import checks
from torchelev.io.export import SavedMap
from torchelev.layers import MODES
from torchelev.ops.masks import count
from torchelev.ops.storage import keep_freed_memory
from torchelev.site.align import align
from torchelev.site.config import SiteConfig
from torchelev.site.give import center_on, fill, remember_given
from torchelev.site.merge import MergeReport, merge_windows
from torchelev.site.reading import Clock, check_layers, read_area, sample_tiles
from torchelev.site.tiles import LAYERS as STORED
from torchelev.site.tiles import TILE, Tiles, locate
from torchelev.site.windows import Alignment, Told, Windows, drop_reset, no_alignment, read_windows, snapshot
from torchelev.stages.initialize import Remembered
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.site.storage.store import TileStore

# By map and site: what a map has told. Of all sites of a process, so that a site may be closed and opened again.
_told: WeakKeyDictionary[ElevationMap, dict[str, Told]] = WeakKeyDictionary()


class SiteMap:
    """A world map that grows: the windows of many robots, in one frame.

    ```python
    site = SiteMap(resolution=0.1, path="site")              # a folder; None: in memory
    while exploring:
        emap.update(points, T_map_sensor, T_map_base, dt)    # B robots
        report = site.merge(emap)                            # every second or so
    values, valid = site.sample(xy)
    ```

    It is made of square tiles, of which a merge touches those below the windows alone. On disk, a merge is written
    completely or not at all, and memory does not grow with the area.

    Args:
        resolution: [m] of the cells, as of the maps that are merged.
        path: the folder to keep it in, which needs ``torchelev[site]``. A site that is there already is continued.
            None: in memory, 28 bytes for each cell of a tile.
        cfg: how windows are aligned and fused.
        device: that fuses.

    Attributes:
        resolution: [m].
        cfg: settings.

    Raises:
        ValueError: the resolution is not positive or not that of the site at `path`, or there is something else.
        ModuleNotFoundError: tensorstore is missing.
    """

    def __init__(
        self,
        resolution: float = 0.1,
        path: str | Path | None = None,
        *,
        cfg: SiteConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        require_positive(resolution=resolution)
        self.resolution = float(resolution)
        self.cfg = checks.given_or_default(SiteConfig, cfg)
        self._store = None if path is None else _create_or_open(path, self.resolution)
        self._tiles = Tiles(self._store, self.cfg.cache_tiles, device)
        self._id, self._rate = uuid.uuid4().hex, self.cfg.variance_rate
        self._epoch = self._time = self._opened = 0.0  # the last two count from the first
        self._read_attributes()

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        read_only: bool = False,
        cfg: SiteConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> SiteMap:
        """Open a site that is on disk.

        Args:
            path: its folder.
            read_only: read beside a process that writes; `refresh` shows what it has written since.
            cfg: how windows are aligned and fused.
            device: that fuses.

        Raises:
            FileNotFoundError: there is nothing.
            ValueError: it is no site, is damaged, or of a newer version, or another process writes to it.
        """
        from torchelev.site.storage.store import TileStore

        site = cls.__new__(cls)
        site._store = TileStore.open(path, read_only=read_only)
        site.resolution = float(site._store.attributes["resolution"])
        site.cfg = checks.given_or_default(SiteConfig, cfg)
        site._tiles = Tiles(site._store, site.cfg.cache_tiles, device)
        site._id, site._rate, site._epoch, site._time, site._opened = "", site.cfg.variance_rate, 0.0, 0.0, 0.0
        site._read_attributes()
        return site

    # Merging --------------------------------------------------------------------------------------------------------

    @torch.inference_mode(False)  # whose tensors could not be written outside of it
    @torch.no_grad()
    def merge(
        self, emap: ElevationMap, *, time: float | None = None, align: bool = True, tilt: bool = False
    ) -> MergeReport:
        """Fuse what B robots have measured since their last merge.

        First, the robots' heights are aligned with each other and with the site, as each has its own drift. Then their
        cells are fused by their variances; a robot's earlier share of a cell is replaced, so that nothing counts twice.
        Heights that contradict each other are kept apart: the site says the newer one once it is about as sure, and
        the layers `other_elevation`, `other_variance` and `other_time` hold the one that it contradicts.

        Args:
            emap: the map, of the site's resolution. The site recognises it, not copies of it.
            time: [s] now, on any clock that all merges share, such as `time.time()`. None: the site's time goes on by
                what the map has lived since its last merge.
            align: find the robots' offsets; otherwise their heights count as they are.
            tilt: also find how their windows tilt, in roll and pitch.

        Returns:
            Offsets and counts, per robot.

        Raises:
            TypeError: `emap` is no ElevationMap.
            ValueError: it has another resolution, or the site is open read-only. Nothing has changed then.
            OSError: the disk is full; the site is as it was before.
        """
        self._check_merge(emap, time)
        if emap.device.type == "cpu":
            keep_freed_memory()
        told = self._recall_told(emap)
        if self._rate is None:
            self._rate = emap.cfg.aging.variance_rate
        now = self._advance(emap, told, time)
        windows = read_windows(emap, emap.state, now, told)
        alignment = self._align(windows, align, tilt)
        told = snapshot(emap, windows, alignment)
        if self._store is None:  # if it is interrupted, what is in memory may hold a part, which must not count twice
            _told.setdefault(emap, {})[self._id] = told
        contradictions = self._fuse(windows, alignment, now)
        _told.setdefault(emap, {})[self._id] = told
        return MergeReport(*alignment, count(windows.is_new), contradictions)

    def _recall_told(self, emap: ElevationMap) -> Told | None:
        """Return what a map has told since its last reset; None: nothing."""
        told = _told.get(emap, {}).get(self._id)
        return None if told is None else drop_reset(told, emap.num_resets)

    def _check_merge(self, emap: ElevationMap, time: float | None) -> None:
        actual, hint = type(emap).__name__, "give an ElevationMap"
        require(isinstance(emap, ElevationMap), "emap", "must be an ElevationMap", actual, hint, TypeError)
        self.require_resolution(emap)
        require(time is None or math.isfinite(time), "time", "must be a finite number", time, "give seconds")
        read_only = self._store is not None and self._store.is_read_only
        require(not read_only, "site", "must be open for writing", "a read-only site", "open it without read_only")

    def require_resolution(self, emap: ElevationMap) -> None:
        """Raise ValueError unless a map has the site's resolution."""
        actual, rule = emap.cfg.grid.resolution, f"must have the site's resolution, {self.resolution:g} m"
        require(
            math.isclose(actual, self.resolution, rel_tol=1e-9), "emap", rule, f"{actual:g} m", "cells must line up"
        )

    def _advance(self, emap: ElevationMap, told: Told | None, time: float | None) -> float:
        """Return the time of a merge, from the epoch. The first time that is given becomes the epoch."""
        if time is not None:
            if not len(self._tiles):
                self._epoch = time
            return time - self._epoch
        elapsed = emap.state.elapsed
        if told is None:
            return max(self._time, self._opened + float(elapsed.max()) * 1e-9)
        lived = torch.where(told.elapsed >= 0, elapsed - told.elapsed, elapsed)  # an environment that was reset
        return self._time + float(lived.max()) * 1e-9

    def _align(self, windows: Windows, with_offsets: bool, with_tilt: bool) -> Alignment:
        if not with_offsets:
            return no_alignment(len(windows.known.corner), self._tiles.device)
        return align(windows, self._read_cells, self.resolution, self.cfg, with_tilt)

    def _read_cells(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the site's elevation and variance at cells of the lattice, NaN where unknown."""
        elevation, variance, time = self._tiles.look_up(locate(x, y), ("elevation", "variance", "time"))
        return elevation, variance + self._clock.rate * (self._time - time)

    def _fuse(self, windows: Windows, alignment: Alignment, now: float) -> Int[Tensor, "B"]:
        """Fuse windows into tiles, on disk first; return each robot's contradictions."""
        contradictions = torch.zeros(len(windows.known.corner), dtype=torch.int64, device=self._tiles.device)
        time, rate = max(self._time, now), self._clock.rate
        parts = merge_windows(self._tiles, windows, alignment, self.resolution, rate, self.cfg)
        try:
            with self._transaction(time) as write:
                for part in parts:
                    write(part.tiles, part.values.transpose(0, 1).cpu().numpy())
                    self._tiles.write(part.tiles, part.values)
                    contradictions += part.contradictions
        except BaseException:
            self._tiles.forget()
            raise
        self._time = time
        return contradictions

    @torch.inference_mode(False)  # whose tensors could not be written outside of it
    @torch.no_grad()
    def give(self, emap: ElevationMap, T_map_base: Tensor | None, chosen: Bool[Tensor, "B"]) -> MapState:
        """Return a map's state with what the site knows filled in; `ElevationMap.initialize_from` calls it."""
        self.require_resolution(emap)
        told, state = self._recall_told(emap), emap.state
        if T_map_base is not None:
            state = center_on(state, emap, T_map_base, chosen)
        windows = read_windows(emap, state, self._time, told)
        offset = torch.zeros(emap.num_envs) if told is None else told.alignment.offset
        grid = emap.cfg.grid
        areas = self.windows(state.corner, grid.height, grid.width, Remembered._fields)
        after = fill(state, emap, areas, offset, chosen)
        _told.setdefault(emap, {})[self._id] = remember_given(emap, windows, after, told, chosen, self._time)
        return after

    @contextmanager
    def _transaction(self, time: float) -> Iterator[Callable[..., None]]:
        """Yield what writes tiles to disk; in memory alone, nothing does."""
        if self._store is None:
            yield lambda tiles, values: None
        else:
            with self._store.transaction(self._attributes(time)) as write:
                yield write

    # Reading --------------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """The site's time [s]: that of the last merge. Variances and ages are read as of then."""
        return self._epoch + self._time

    @property
    def _clock(self) -> Clock:
        return Clock(self._time, self._rate or 0.0)

    def __len__(self) -> int:
        """Return the number of tiles, of 64 x 64 cells."""
        return len(self._tiles)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The outer borders x_min, x_max, y_min, y_max [m] of its tiles, map frame; all 0 while there are none."""
        tiles = np.array(list(self._tiles) or [(0, 0)])
        (x_min, y_min), (x_max, y_max) = tiles.min(0) * TILE, (tiles.max(0) + bool(len(self))) * TILE
        return tuple(float(cells * self.resolution) for cells in (x_min, x_max, y_min, y_max))  # type: ignore[return-value]

    @property
    def num_bytes(self) -> int:
        """Bytes on disk; 0 in memory."""
        return 0 if self._store is None else self._store.num_bytes

    def sample(
        self, xy: Float[Tensor, "M 2"], layer: str = "elevation", mode: str = "bilinear"
    ) -> tuple[Float[Tensor, "M"], Bool[Tensor, "M"]]:
        """Read a layer at points.

        Args:
            xy: points, map frame [m]; give float64 far from the origin.
            layer: one of `window`'s.
            mode: "bilinear" renormalises over the known ones of the four surrounding cells, and is valid where these
                carry at least half of the weight; "nearest" reads the cell that holds the point.

        Returns:
            values: (M,), 0 where not valid.
            valid: (M,) bool.

        Raises:
            KeyError: there is no such layer.
            ValueError: the mode is unknown, or `xy` is not (M, 2).
        """
        xy = torch.as_tensor(xy)
        is_list = xy.ndim == 2 and xy.shape[1] == 2
        require(is_list, "xy", "expected (M, 2)", tuple(xy.shape), "give one x and y for each point")
        require(mode in MODES, "mode", f"must be one of {', '.join(MODES)}", repr(mode), "use bilinear")
        (layer,) = check_layers([layer])
        cells = xy.detach().to(self._tiles.device, torch.float64) / self.resolution
        return sample_tiles(self._tiles, cells, layer, mode, self._clock)

    def window(
        self,
        center: Sequence[float] | Tensor,
        length_x: float,
        length_y: float,
        layers: Sequence[str] | None = None,
    ) -> SavedMap:
        """Copy an area to NumPy arrays, as of the site's time.

        - elevation [m], variance [m^2], time [s] since the last measurement, upper_bound [m] and validity are those of
          `ElevationMap.layer`.
        - other_elevation [m], other_variance [m^2] and other_time [s]: what contradicts the elevation.

        Args:
            center: x, y [m], map frame; the area's centre is the nearest point at which its cells line up.
            length_x: [m], a whole number of cells.
            length_y: [m], a whole number of cells.
            layers: names; None: all.

        Returns:
            The layers (H, W), NaN where unknown, and their geometry.

        Raises:
            KeyError: a layer does not exist.
            ValueError: a length is no whole number of cells.
        """
        grid = GridConfig(resolution=self.resolution, length_x=length_x, length_y=length_y)
        x, y = (float(value) for value in center[:2])
        size = (grid.height, grid.width)
        first = [math.floor(c / self.resolution - n / 2 + 0.5) for c, n in zip((x, y), size, strict=True)]
        corner = (first[0], first[1])
        names = check_layers(layers)
        area = read_area(self._tiles, corner, size, names, self._clock)
        middle = [(c + n / 2) * self.resolution for c, n in zip(corner, size, strict=True)]
        arrays = {name: value.numpy() for name, value in area.items()}
        config = ElevationMapConfig(grid=grid).to_dict()
        return SavedMap(arrays, self.resolution, np.array([*middle, 0.0]), config)

    def windows(
        self, corner: Int[Tensor, "B 2"], height: int, width: int, layers: Sequence[str]
    ) -> dict[str, Float[Tensor, "B H W"]]:
        """Return layers of B areas of height x width cells, whose first cells have these numbers on the lattice."""
        names, size = check_layers(layers), (height, width)
        areas = [read_area(self._tiles, (x, y), size, names, self._clock) for x, y in corner.tolist()]
        return {name: torch.stack([area[name] for area in areas]) for name in layers}

    # Files ----------------------------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Read again what another process has written since. Only of use for a site that is open read-only."""
        if self._store is not None:
            self._store.refresh()
            self._tiles.forget()
            self._read_attributes()

    def close(self) -> None:
        """Let other processes write to the site's folder. All merges are on disk already."""
        if self._store is not None:
            self._store.close()

    def __enter__(self) -> SiteMap:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _attributes(self, time: float) -> dict[str, Any]:
        own = {"resolution": self.resolution, "id": self._id, "epoch": self._epoch, "time": time}
        return own | {"variance_rate": self._rate}

    def _read_attributes(self) -> None:
        if self._store is not None and "id" in self._store.attributes:
            stored = self._store.attributes
            self._id, self._epoch, self._time = stored["id"], stored["epoch"], stored["time"]
            self._opened = self._time
            self._rate = stored["variance_rate"] if self.cfg.variance_rate is None else self.cfg.variance_rate


def _create_or_open(path: str | Path, resolution: float) -> TileStore:
    """Create a site's folder, or open one that is there, of the same resolution."""
    from torchelev.site.storage.store import TileStore

    path = Path(path)
    if not (path / "zarr.json").exists():
        return TileStore.create(path, layers=STORED, tile_size=TILE, attributes={"resolution": resolution})
    store = TileStore.open(path)
    actual = float(store.attributes["resolution"])
    if not math.isclose(actual, resolution, rel_tol=1e-9):
        store.close()
    hint = "give that resolution, or another path"
    require(
        math.isclose(actual, resolution, rel_tol=1e-9),
        "resolution",
        f"must be {actual:g} m, that of {path}",
        resolution,
        hint,
    )
    return store
