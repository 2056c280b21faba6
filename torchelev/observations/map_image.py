"""Images of the map around the robots, for convolutional policies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive, whole_cells
from torchelev.grid import GridConfig
from torchelev.layers import Layer
from torchelev.levels.state import Levels
from torchelev.observations import image_kernel, patterns
from torchelev.observations.channel_reading import count_rows, parse_channels, read_channels
from torchelev.observations.fill import read_points, require_mode
from torchelev.observations.image_kernel import Channels
from torchelev.observations.inputs import check_base
from torchelev.observations.patterns import Pattern
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float

CHANNELS = ("elevation", "validity", "variance", "upper_bound", "traversability", "clearance")
HEIGHTS = ("elevation", "upper_bound")  # they count from the ground below the base


@dataclass(frozen=True, kw_only=True)
class MapImage:
    """Read the map around the base as images (B, C, H, W), for convolutional policies.

    H = length_x / resolution and W = length_y / resolution. Index [i, j]: i grows with +x, j with +y; the centre of a
    pixel is at offset + (i + 0.5 - H / 2, j + 0.5 - W / 2) * resolution. Unknown pixels are 0 in every layer.

    Layers:

    - "elevation" and "upper_bound" [m], above the ground `nominal_height` below the base
    - "validity", 1 where the elevation is known
    - "variance" [m^2]
    - "traversability", 0 (bad) to 1 (good)
    - "clearance" [m] below the ceiling, at most `max_clearance`, which open ground reads, and 0 where nobody looked:
      maps whose config has a `LevelsConfig` know it

    After them come the components of `channels`, such as `MapImage(channels=("rgb", "terrain.stone"))`, each read in
    the cell that holds the pixel's centre.

    Raises:
        ValueError: for a setting out of range.
    """

    length_x: float = 1.6  #: [m] along x, a whole number of pixels
    length_y: float = 1.6  #: [m] along y, a whole number of pixels
    resolution: float = 0.05  #: [m] side of a pixel
    offset: tuple[float, float] = (0.0, 0.0)  #: [m] centre of the image (x, y), base frame
    layers: tuple[str, ...] = ("elevation", "validity", "upper_bound", "traversability")  #: in this order
    #: of the map's config, after the layers: "rgb" for all its components, or "terrain.stone" for one
    channels: tuple[str, ...] = ()
    channel_fill: float = 0.0  #: value of channels in pixels where they are unknown
    #: "yaw" turns the image with the base's heading; "base" turns it in 3D and drops z; "world" only moves it
    alignment: str = "yaw"
    mode: str = "bilinear"  #: how the map is read: "bilinear", "nearest" or "minimum", as of `HeightScan`
    nominal_height: float = 0.0  #: [m] of the base over flat ground: that ground then has elevation 0
    max_clearance: float = 3.0  #: [m] read where the clearance is larger, or nothing hangs above the ground
    _size: tuple[int, int] = field(init=False, repr=False, compare=False)  # H and W
    _pattern: Pattern = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        H, W = (whole_cells(name, getattr(self, name), self.resolution) for name in ("length_x", "length_y"))
        object.__setattr__(self, "channels", parse_channels(self.channels, self.channel_fill))
        are_layers = len(self.layers) > 0 and all(name in CHANNELS for name in self.layers)
        hint = "correct their names, or give those of the map's channels as channels=(...)"
        require(are_layers, "layers", f"must be some of {', '.join(CHANNELS)}", repr(self.layers), hint)
        require_mode(self.mode)
        require_positive(max_clearance=self.max_clearance)
        require(math.isfinite(self.nominal_height), "nominal_height", "must be finite", self.nominal_height, "give 0")
        axes = zip(self.offset, (H, W), strict=True)
        x, y = (patterns.space_around(middle, count, self.resolution) for middle, count in axes)
        object.__setattr__(self, "_size", (H, W))
        points = patterns.parse_points(patterns.order_y_fastest(x, y))
        object.__setattr__(self, "_pattern", Pattern(points, self.alignment))

    def __call__(
        self,
        emap: ElevationMap,
        T_map_base: Float[Tensor, "B 4 4"],
        *,
        state: MapState | None = None,
        levels: Levels | None = None,
    ) -> Float[Tensor, "B C H W"]:
        """Read an image around the base of each environment.

        Its layers are differentiable in the state and the levels and, in bilinear mode, in T_map_base; channels are
        constants.

        Args:
            emap: the maps.
            T_map_base: base poses, in float64 far from the origin.
            state: the state to read; None: that of the maps.
            levels: the other surfaces to read, as `forward` returns them; None: the maps'.

        Returns:
            A fresh tensor without NaN.

        Raises:
            ValueError, TypeError: for a wrong shape, dtype or device, or a window too small for the image.
            KeyError: for layers of maps without levels, or channels that the maps lack.
        """
        grid = emap.cfg.grid
        self._pattern.require_inside(grid)
        T_map_base = check_base(emap, T_map_base)
        current = emap.state if state is None else state
        layers = {name: emap.read_layer(name, state, levels) for name in self._read_alone}
        if "clearance" in layers:
            clearance, known = layers["clearance"]
            layers["clearance"] = clearance.clamp(max=self.max_clearance), known
        is_plain = len(set(self.layers)) == len(self.layers)
        if is_plain and image_kernel.can_read(T_map_base, current.corner, _tensors(layers, current)):
            images = image_kernel.read_images(
                self._sources(layers, current),
                *(self._pattern, T_map_base, current.corner, grid),
                *(self.mode, self.nominal_height, len(self.layers)),
            )
        else:
            bound = {"upper_bound": emap.read_layer("upper_bound", state)} if "upper_bound" in self.layers else {}
            images = self._read_in_torch(layers | bound, current, grid, T_map_base)
        if self.channels:
            uv = self._place(T_map_base, current, grid)
            rows, _ = read_channels(self.channels, self.channel_fill, emap, uv, state)
            images = torch.cat([images, rows], 1)
        return images.unflatten(-1, self._size)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, H, W), for the policy's input layer; of an image with channels, `shape_on` returns it.

        Raises:
            ValueError: if there are channels, whose number of components the map's config says.
        """
        hint = "use shape_on(cfg) with the config of the maps"
        require(not self.channels, "shape", "must be of an image without channels", self.channels, hint)
        return (len(self.layers), *self._size)

    def shape_on(self, cfg: ElevationMapConfig) -> tuple[int, int, int]:
        """Return (C, H, W) on maps of a config, for the policy's input layer.

        Raises:
            KeyError: if a channel is not there.
        """
        return (len(self.layers) + count_rows(self.channels, cfg), *self._size)

    def _place(self, T_map_base: Tensor, state: MapState, grid: GridConfig) -> Float[Tensor, "B M 2"]:
        """Return the centres of the pixels, in cells from the window's corner."""
        base, dtype = T_map_base[:, None, :3, 3], state.elevation.dtype
        return self._pattern.place(T_map_base, base, state.corner, grid.resolution, dtype)

    @property
    def _read_alone(self) -> list[str]:
        """Layers whose values do not hide those of others; "upper_bound" is where no elevation does."""
        hidden = {"validity": "elevation", "upper_bound": "elevation"}
        return list(dict.fromkeys(hidden.get(name, name) for name in self.layers))

    def _sources(self, layers: dict[str, Layer], state: MapState) -> Iterator[Channels]:
        """Yield which channels each layer becomes."""
        places = {name: index for index, name in enumerate(self.layers)}
        for name, layer in layers.items():
            validity = places.get("validity", -1) if name == "elevation" else -1
            if name in places or validity >= 0:
                yield Channels(layer, None, places.get(name, -1), validity, name in HEIGHTS)
        if "upper_bound" in places:
            bound = state.upper_bound, state.bounded
            yield Channels(layers["elevation"], bound, places["upper_bound"], -1, True)

    def _read_in_torch(
        self, layers: dict[str, Layer], state: MapState, grid: GridConfig, T_map_base: Tensor
    ) -> Float[Tensor, "B C M"]:
        """Read the channels of layers by tensors: this is the definition."""
        uv = self._place(T_map_base, state, grid)
        reference = T_map_base[:, None, 2, 3].to(uv.dtype) - self.nominal_height
        read = dict(zip(layers, read_points(list(layers.values()), uv, grid, self.mode), strict=True))
        images = torch.stack([_channel(name, read, reference) for name in self.layers], 1)
        return torch.where(torch.isfinite(reference)[:, None], images, 0.0)

    def xy(self, T_map_base: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B M 2"]:
        """Return the centres of the pixels [m], map frame, row by row, for instance for `ElevationMap.sample`.

        In the dtype of the poses, and differentiable in them.
        """
        corner = torch.zeros(len(T_map_base), 2, dtype=torch.int64, device=T_map_base.device)
        return self._pattern.place(T_map_base, T_map_base[:, None, :3, 3], corner, 1.0, T_map_base.dtype)


def _tensors(layers: dict[str, Layer], state: MapState) -> list[Tensor]:
    """Return all tensors that an image may read."""
    return [state.upper_bound, state.bounded, *(value for layer in layers.values() for value in layer)]


def _channel(name: str, read: dict[str, Layer], reference: Float[Tensor, "B 1"]) -> Float[Tensor, "B M"]:
    """Return one channel of an image."""
    if name == "validity":
        return read["elevation"][1].to(reference.dtype)
    values, known = read[name]
    return torch.where(known, values - reference, 0.0) if name in HEIGHTS else values
