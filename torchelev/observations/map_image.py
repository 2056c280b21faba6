"""The map around the robots as images, for convolutional policies."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, whole_cells
from torchelev.layers import Layer
from torchelev.observations import patterns
from torchelev.observations.fill import read_points, require_mode
from torchelev.observations.height_scan import check_base
from torchelev.observations.patterns import Pattern, centered
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float

CHANNELS = ("elevation", "validity", "variance", "upper_bound", "traversability")


@dataclass(frozen=True, kw_only=True)
class MapImage:
    """The map around the base as images (B, C, H, W) for convolutions.

    H = length_x / resolution, W = length_y / resolution. Index [i, j]: i grows with +x, j with +y; the pixels' centres
    lie at offset + (i + 0.5 - H / 2) * resolution. Channels: "elevation" and "upper_bound" [m], counted from the ground
    `nominal_height` below the base; "validity", 1 where the elevation is known; "variance" [m^2]; "traversability", 0
    to 1, the better. What is not known is 0 in every channel.

    Raises ValueError for settings out of range.
    """

    length_x: float = 1.6  #: [m]
    length_y: float = 1.6  #: [m]
    resolution: float = 0.05  #: [m]
    offset: tuple[float, float] = (0.0, 0.0)  #: [m] the image's middle, x and y from the base
    layers: tuple[str, ...] = ("elevation", "validity", "upper_bound", "traversability")  #: channels, in this order
    alignment: str = "yaw"  #: as of HeightScan
    mode: str = "bilinear"  #: "bilinear" or "nearest" reading of the map
    nominal_height: float = 0.0  #: [m] of the base over flat ground
    shape: tuple[int, int, int] = field(init=False)  #: C, H, W
    _pattern: Pattern = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        H, W = (whole_cells(name, getattr(self, name), self.resolution) for name in ("length_x", "length_y"))
        known = len(self.layers) > 0 and all(name in CHANNELS for name in self.layers)
        require(known, "layers", f"must be some of {', '.join(CHANNELS)}", repr(self.layers), "correct their names")
        require_mode(self.mode)
        require(math.isfinite(self.nominal_height), "nominal_height", "must be finite", self.nominal_height, "give 0")
        x, y = (centered(n, self.resolution, at) for n, at in zip((H, W), self.offset, strict=True))
        object.__setattr__(self, "shape", (len(self.layers), H, W))
        object.__setattr__(self, "_pattern", Pattern(patterns.as_points(patterns.y_fastest(x, y)), self.alignment))

    def __call__(
        self, emap: ElevationMap, T_map_base: Float[Tensor, "B 4 4"], *, state: MapState | None = None
    ) -> Float[Tensor, "B C H W"]:
        """Read the images around the robots: a fresh tensor without NaN, differentiable as a height scan is.

        Raises ValueError or TypeError for inputs that do not fit, and for a window that the image does not fit into.
        """
        grid = emap.cfg.grid
        self._pattern.require_inside(grid)
        T_map_base = check_base(emap, T_map_base)
        state = emap.state if state is None else state
        base = T_map_base[:, None, :3, 3]
        uv = self._pattern.place(T_map_base, base, state.corner, grid.resolution, state.elevation.dtype)
        floor = base[..., 2].to(uv.dtype) - self.nominal_height
        sources = dict.fromkeys("elevation" if name == "validity" else name for name in self.layers)
        sampled = read_points([emap.read_layer(name, state) for name in sources], uv, grid, self.mode)
        read = dict(zip(sources, sampled, strict=True))
        images = torch.stack([_channel(name, read, floor) for name in self.layers], 1)
        return torch.where(torch.isfinite(floor)[:, None], images, 0.0).unflatten(-1, self.shape[1:])

    def xy(self, T_map_base: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B M 2"]:
        """Return where the pixels lie [m], map frame, row by row: to read what else is known of those places.

        In the dtype of the poses, and differentiable in them.
        """
        origin = torch.zeros(len(T_map_base), 2, dtype=torch.int64, device=T_map_base.device)
        return self._pattern.place(T_map_base, T_map_base[:, None, :3, 3], origin, 1.0, T_map_base.dtype)


def _channel(name: str, read: dict[str, Layer], floor: Float[Tensor, "B 1"]) -> Float[Tensor, "B M"]:
    """Return one channel of an image."""
    if name == "validity":
        return read["elevation"][1].to(floor.dtype)
    values, known = read[name]
    return torch.where(known, values - floor, 0.0) if name in ("elevation", "upper_bound") else values
