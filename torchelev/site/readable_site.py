"""Reading a site: `SiteMap` without merging."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.io.export import SavedMap
from torchelev.layers import MODES
from torchelev.site.areas import place_area, save_area
from torchelev.site.content.reading import Clock, check_layer, check_layers, read_area, sample_tiles
from torchelev.site.content.tiles import TILE, Tiles
from torchelev.site.site_export import Moment, Place, choose_area, export

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from typing_extensions import Self

    from torchelev.site.storage.interface import SiteStore


class ReadableSite:
    """A site that can be read: at points, as areas, as files."""

    resolution: float
    _tiles: Tiles
    _store: SiteStore | None
    _rate: float | None
    _epoch: float
    _time: float

    @property
    def time(self) -> float:
        """The site's time [s]: that of the last merge. Variances and ages are read as of then."""
        return self._epoch + self._time

    @property
    def version(self) -> str:
        """The id of the version that the site shows."""
        raise NotImplementedError

    @property
    def _clock(self) -> Clock:
        return Clock(self._time, self._rate or 0.0)

    def __len__(self) -> int:
        """Return the number of tiles, of 64 x 64 cells."""
        return len(self._tiles)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The outer borders x_min, x_max, y_min, y_max [m] of its tiles, map frame; all 0 while there are none.

        Tiles are 64 cells wide and may be known in part: the known cells may end up to 63 cells before these borders.
        """
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
            layer: one of `window`'s; of a channel with several components, one of these.
            mode: "bilinear" renormalises over the known ones of the four surrounding cells, and is valid where these
                carry at least half of the weight; "nearest" reads the cell that holds the point. Bilinear means mix
                the two heights of a contradiction where neighbouring cells say different ones: use "nearest" there.

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
        cells = xy.detach().to(self._tiles.device, torch.float64) / self.resolution
        return sample_tiles(self._tiles, cells, check_layer("layer", layer, self._tiles), mode, self._clock)

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
        - a channel of the site, or one of its components, such as "rgb" or "rgb.red".
        - of a site with levels: ceiling [m] and clearance [m] above the elevation, inf where nothing hangs, and
          level0.elevation, .underside [m], .variance [m^2] and .time [s] of each cell's lowest surface, level1 of the
          next one.

        Args:
            center: x, y [m], map frame; the area's centre is the nearest point at which its cells line up.
            length_x: [m], a whole number of cells.
            length_y: [m], a whole number of cells.
            layers: names; None: all.

        Returns:
            The layers (H, W), NaN where unknown, and their geometry.

        Raises:
            KeyError: a layer does not exist.
            TypeError: `layers` is one name, not a list.
            ValueError: a length is not a whole number of cells, or the centre is not a point.
        """
        corner, size = place_area(center, length_x, length_y, self.resolution)
        return self._copy(corner, size, check_layers(layers, self._tiles))

    def _copy(self, corner: tuple[int, int], size: tuple[int, int], names: Sequence[str]) -> SavedMap:
        """Copy an area whose first cell has these numbers on the lattice."""
        area = read_area(self._tiles, corner, size, names, self._clock)
        arrays = {name: value.numpy() for name, value in area.items()}
        kept = {"channels": self._tiles.channels.configs, "levels": self._tiles.levels.cfg}
        return save_area(arrays, corner, size, self.resolution, **kept)

    def windows(
        self, corner: Int[Tensor, "B 2"], height: int, width: int, layers: Sequence[str]
    ) -> dict[str, Float[Tensor, "B H W"]]:
        """Return layers of B areas of height x width cells, whose first cells have these numbers on the lattice."""
        names, size = check_layers(layers, self._tiles), (height, width)
        areas = [read_area(self._tiles, (x, y), size, names, self._clock) for x, y in corner.tolist()]
        return {name: torch.stack([area[name] for area in areas]).to(self._tiles.device) for name in layers}

    # Files ----------------------------------------------------------------------------------------------------------

    def export(
        self,
        path: str | Path,
        layers: Sequence[str] = ("elevation",),
        area: Sequence[float] | None = None,
        *,
        epsg: int | None = None,
        origin: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Write an area to a file in the format of its suffix, completely or not at all.

        - `.tif`: a cloud-optimised GeoTIFF with a float32 band for each layer, NaN where unknown, and overviews whose
          pixels are means of known ones. It names the site's version and time, SITE_VERSION and SITE_TIME [s], and has
          the time as its date, in UTC, if that is Unix time: from 1e9 s on. Written block by block, so that memory does
          not grow with the area. Needs ``torchelev[geo]``.
        - `.png`: a picture of one layer, shaded and coloured, transparent where unknown. Its text says which values
          the colours stand for, and the world file `.pgw` beside it where the picture lies. Needs ``torchelev[io]``.
        - `.ply`: one layer as a triangle mesh, as `torchelev.io.export.save_mesh` writes it. Needs ``torchelev[io]``.
        - `.npz`: arrays, which `torchelev.io.export.load_npz` reads.

        Pictures and GeoTIFFs have north up: x points east, y north.

        Args:
            path: of the file.
            layers: names as in `window`; one for `.png` and `.ply`.
            area: x_min, x_max, y_min, y_max [m], map frame, made larger to whole cells. None: all that is known.
            epsg: code of the projected coordinate system, such as 32632 for UTM zone 32N, for `.tif`.
            origin: easting and northing [m] of the map frame's origin in it, for `.tif` and `.png`.

        Raises:
            KeyError: a layer does not exist.
            TypeError: `layers` is one name, not a list.
            ValueError: another argument breaks its rule, the area is too large for the kind, or nothing is known yet.
            WriteError: the file cannot be written, or its folder does not exist; an existing file is left as it was.
            ModuleNotFoundError: a package is missing; the text says which extra installs it.
        """
        names = check_layers(layers, self._tiles)
        export(
            path,
            choose_area(self._tiles, names, area, self.resolution, self._copy),
            Place(epsg, origin),
            Moment(self.version, self.time),
        )

    def refresh(self) -> None:
        """Read what another process has written since. Useful only for a site that is open read-only."""
        if self._store is not None:
            self._store.refresh()
            self._tiles.forget()
            self._read_attributes()

    def close(self) -> None:
        """Let other processes write to the site's folder. All merges are on disk already.

        From then on, `merge` and `move_keyframes` raise ValueError; reading still works. In memory, does nothing.
        """
        if self._store is not None:
            self._store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read_attributes(self) -> None:
        """Take the values of the store's attributes."""
