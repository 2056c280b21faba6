"""Height scans for policies: drop-in for those of Isaac Lab, mjlab and legged_gym, on grids, points, or around feet."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive, whole_cells
from torchelev.levels.state import Levels
from torchelev.observations import patterns
from torchelev.observations.scan import presets
from torchelev.observations.scan.presets import PRESETS
from torchelev.observations.scan.reading import read_scan
from torchelev.observations.scan.settings import ScanSettings
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True, kw_only=True)
class HeightScan(ScanSettings):
    """Read the heights of the base, or of the feet, above the ground at the points of a pattern.

    value = scale * clip(z - elevation - nominal_height + noise, -clip, clip) with z [m] of the base or foot, map frame.

    With `channels`, such as `HeightScan.grid(channels=("rgb", "terrain.stone"))`, the values are (B, 1 + C, P): the
    heights, then a row for each component of the map's channels.

    Build one with `isaac_lab`, `mjlab`, `legged_gym`, `grid`, `points` or `feet`. All of them take the fields of
    `ScanSettings` as further keyword arguments, such as `fill`, the rule for unknown cells. A scan does not
    change; `dataclasses.replace` returns one with other settings.
    """

    @classmethod
    def preset(cls, name: str, **settings: Any) -> HeightScan:
        """Build the preset of this name: "isaac_lab", "mjlab" or "legged_gym", as read from a file or command line."""
        require(name in PRESETS, "preset", f"must be one of {', '.join(PRESETS)}", repr(name), "use isaac_lab")
        return getattr(cls, name)(**settings)

    @classmethod
    def isaac_lab(
        cls, *, length_x: float = 1.6, length_y: float = 1.0, resolution: float = 0.1, **settings: Any
    ) -> HeightScan:
        """Build Isaac Lab's `height_scan`: clip(z - elevation - 0.5, -1, 1), by default 187 values.

        - Order: x fastest, from behind to ahead, then y from right to left. `values.view(B, 11, 17)[b, j, i]` is at
          (x_i, y_j).
        - Spacing: `arange(-length / 2, length / 2 + 1e-9, resolution)`. A grid whose length is not a multiple of the
          resolution ends short of it: 1.1 m at 0.04 m gives 28 points, the last one at 0.53 m.
        - Offset 0.5 m, clip +-1 m, scale 1: flat ground reads the height of the base less 0.5 m.
        - Unknown cells: the known ground continues; on an empty map all points read `standing_height` - 0.5 m, which is
          0 unless you set it. `fill="original"` reads -1, like a wall: in Isaac Lab a ray without a hit returns inf.
        - Noise, if a call asks for it: uniform in +-0.1 m, before the clip.

        Args:
            length_x: length of the grid along x [m].
            length_y: length of the grid along y [m].
            resolution: spacing of the points [m].
            **settings: fields of `ScanSettings` that replace those of the preset.
        """
        require_positive(length_x=length_x, length_y=length_y, resolution=resolution)
        points = presets.isaac_lab_points(length_x, length_y, resolution)
        return cls(pattern=points, **(presets.ISAAC_LAB | settings))

    @classmethod
    def mjlab(
        cls, *, length_x: float = 1.6, length_y: float = 1.0, resolution: float = 0.1, **settings: Any
    ) -> HeightScan:
        """Build mjlab's `height_scan`: (z - elevation) / 5, by default 187 values.

        - Order: x fastest, from behind to ahead, then y from right to left. `values.view(B, 11, 17)[b, j, i]` is at
          (x_i, y_j).
        - Spacing: `arange(-length / 2, length / 2 + resolution / 2, resolution)`. A grid whose length is not a multiple
          of the resolution may end beyond it: 1.1 m at 0.04 m gives 29 points, the last one at 0.57 m.
        - No offset, no clip, scale 1 / 5: flat ground reads the height of the base / 5 m.
        - Unknown cells: the known ground continues; on an empty map all points read `standing_height` / 5 m, with 0.5 m
          by default: set it to your robot's. `fill="original"` reads 1, like a pit: in mjlab a ray without a hit
          returns its range of 5 m.
        - Noise, if a call asks for it: uniform in +-0.1 m, before the scale.

        Args:
            length_x: length of the grid along x [m].
            length_y: length of the grid along y [m].
            resolution: spacing of the points [m].
            **settings: fields of `ScanSettings` that replace those of the preset.
        """
        require_positive(length_x=length_x, length_y=length_y, resolution=resolution)
        points = presets.mjlab_points(length_x, length_y, resolution)
        return cls(pattern=points, **(presets.MJLAB | settings))

    @classmethod
    def legged_gym(
        cls, *, x: Sequence[float] = presets.LEGGED_GYM_X, y: Sequence[float] = presets.LEGGED_GYM_Y, **settings: Any
    ) -> HeightScan:
        """Build legged_gym's height measurements: 5 clip(z - 0.5 - elevation, -1, 1), by default 187 values.

        - Order: y fastest, from right to left, then x from behind to ahead. `values.view(B, 17, 11)[b, i, j]` is at
          (x_i, y_j).
        - Spacing: the given coordinates, by default every 0.1 m of 1.6 x 1.0 m.
        - Offset 0.5 m, clip +-1 m, scale 5: flat ground reads 5 times the height of the base less 0.5 m.
        - Elevation: the lowest of three vertices of a height field, in legged_gym 0.1 m apart by default, here cells,
          one map resolution apart. `mode="bilinear"` reads the ground itself.
        - Unknown cells: the known ground continues; on an empty map all points read 5 (`standing_height` - 0.5 m),
          which is 0 unless you set it. `fill="original"` reads that value at every unknown cell: legged_gym clamps its
          indices to the height field, so nothing is ever missed there.
        - Noise, if a call asks for it: uniform in +-0.1 m, after the clip, so that values reach +-5.5.

        Args:
            x: `measured_points_x` [m].
            y: `measured_points_y` [m].
            **settings: fields of `ScanSettings` that replace those of the preset.
        """
        return cls(pattern=patterns.order_y_fastest(x, y), **(presets.LEGGED_GYM | settings))

    @classmethod
    def grid(
        cls,
        *,
        length_x: float = 1.6,
        length_y: float = 1.0,
        resolution: float = 0.1,
        offset: tuple[float, float] = (0.0, 0.0),
        **settings: Any,
    ) -> HeightScan:
        """Build a grid scan: z - elevation, indexed like a layer, by default 187 values.

        - Order: y fastest, like the cells of a layer. `values.view(B, 17, 11)[b, i, j]` is at (x_i, y_j); i grows with
          +x, j with +y.
        - Spacing: whole steps of `resolution` with both ends included, centred on `offset`.
        - No offset in height, no clip, scale 1, no noise.
        - Unknown cells: the known ground continues; on an empty map all points read `standing_height`, by default 0.

        Args:
            length_x: length along x [m], a whole number of steps.
            length_y: length along y [m], a whole number of steps.
            resolution: spacing of the points [m].
            offset: centre of the grid (x, y) [m], base frame.
            **settings: fields of `ScanSettings`.
        """
        lengths = (("length_x", length_x), ("length_y", length_y))
        counts = [whole_cells(name, length, resolution) + 1 for name, length in lengths]
        x, y = (patterns.space_around(middle, n, resolution) for middle, n in zip(offset, counts, strict=True))
        return cls(pattern=patterns.order_y_fastest(x, y), **settings)

    @classmethod
    def points(cls, xy: Any, **settings: Any) -> HeightScan:
        """Build a scan of any points: z - elevation, in their order; else as `grid`.

        Args:
            xy: points (P, 2) [m], base frame: a tensor, an array or a list of pairs.
            **settings: fields of `ScanSettings`.
        """
        return cls(pattern=xy, **settings)

    @classmethod
    def feet(
        cls,
        *,
        num_feet: int = 4,
        rings: Iterable[tuple[float, int]] = presets.RINGS,
        reach: float = 0.6,
        **settings: Any,
    ) -> HeightScan:
        """Build a scan of rings around each foot: z of the foot - elevation, by default 4 x 52 values.

        - Order: foot by foot, as in the `feet` given to a call; for each foot ring by ring; on each ring from straight
          ahead of the base counter-clockwise, to the left. `values.view(B, num_feet, 52)`.
        - Spacing: equal angles. By default the rings of Miki et al. 2022 (Science Robotics): radii of 0.08, 0.16, 0.26,
          0.36 and 0.48 m with 6, 8, 10, 12 and 16 points.
        - No offset, no clip, scale 1, no noise.
        - Unknown cells: the known ground continues; on an empty map all points read `standing_height`, by default 0:
          flat ground at the height of the foot.

        Args:
            num_feet: number of feet.
            rings: radius [m] and number of points of each ring.
            reach: largest horizontal distance of a foot from the base [m]: the map's window must hold rings there.
            **settings: fields of `ScanSettings`.
        """
        require(num_feet != 0, "num_feet", "must be positive", num_feet, "use HeightScan.points around the base")
        return cls(pattern=patterns.place_rings(rings), num_feet=num_feet, reach=reach, **settings)

    def __call__(
        self,
        emap: ElevationMap,
        T_map_base: Float[Tensor, "B 4 4"],
        feet: Float[Tensor, "B K 3"] | None = None,
        *,
        noise: bool | Float[Tensor, "B P"] = False,
        state: MapState | None = None,
        levels: Levels | None = None,
    ) -> tuple[Float[Tensor, "B *rows P"], Bool[Tensor, "B *rows P"]]:
        """Read the scan of each environment.

        The heights are differentiable in the state and the levels and, in bilinear mode, in T_map_base and feet;
        channels, which are read in single cells, are constants. The first call on a device copies the pattern there:
        make one before you capture a CUDA graph.

        Args:
            emap: the maps.
            T_map_base: base poses, in float64 far from the origin.
            feet: positions of the feet [m], map frame, for a scan around feet.
            noise: True adds noise; a tensor in [0, 1), as from `torch.rand`, adds the noise of these draws.
            state: the state to read; None: that of the maps.
            levels: the other surfaces to read, as `forward` returns them, for a scan of the ceiling; None: the maps'.

        Returns:
            Values, and whether the elevation at each point is known, (B, P) both. With `channels` both are
            (B, 1 + C, P), of which row 0 is that of the heights and the others are those of the C components in the
            order of `channels`, each known where its channel is: `.flatten(1)` for a policy that takes (B, D). The
            values are fresh tensors without NaN: unknown cells are filled.

        Raises:
            ValueError, TypeError: for a wrong shape, dtype or device, or a window too small for the pattern.
            KeyError: if the maps lack one of `channels`.
        """
        return read_scan(self, emap, T_map_base, feet, noise, state, levels)

    def xy(
        self, T_map_base: Float[Tensor, "B 4 4"], feet: Float[Tensor, "B K 3"] | None = None
    ) -> Float[Tensor, "B P 2"]:
        """Return the points of the scan [m], map frame, in its order, for instance to draw them.

        Args:
            T_map_base: base poses.
            feet: positions of the feet [m], map frame, for a scan around feet.

        Raises:
            ValueError: feet are given for a scan around the base, or left out for one around feet.
        """
        actual = None if feet is None else tuple(feet.shape)
        rule = f"expected (B, {self.num_feet}, 3)" if self.num_feet else "must be left out for a scan around the base"
        require(
            (feet is not None) == bool(self.num_feet), "feet", rule, actual, "give the feet of HeightScan.feet only"
        )
        corner = torch.zeros(len(T_map_base), 2, dtype=torch.int64, device=T_map_base.device)
        origin = T_map_base[:, None, :3, 3] if feet is None else feet
        return self.placement.place(T_map_base, origin, corner, 1.0, T_map_base.dtype)
