"""What a policy reads: height scans, drop-in for those that policies are trained with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev import checks
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive, whole_cells
from torchelev.observations import patterns
from torchelev.observations.fill import FILLS, ORIGINAL, fill_unknown, read_points, require_fill, require_mode
from torchelev.observations.patterns import Pattern, Points, centered, grid_coordinates, steps
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

PRESETS = ("isaac_lab", "mjlab", "legged_gym")


@dataclass(frozen=True, kw_only=True)
class HeightScan:
    """Heights of the base, or of the feet, above the ground at the points of a pattern.

    value = scale * clip(z - elevation - nominal_height + noise), z of the base or foot; legged_gym's noise comes after
    its clip. Build one with `isaac_lab`, `mjlab`, `legged_gym`, `grid`, `points` or `feet`, which all take the settings
    below; `dataclasses.replace` changes one.

    `alignment`: "yaw" turns the pattern with the base's heading (`scan_patterns.heading`); "base" turns it in full and
    drops its height; "world" only moves it. `mode`: see `fill.read_points`.

    `fill`, where nothing is known:
    - "ground", the default: the known ground continues. A point reads the mean of what is known near it, farther away
      flat ground as high as under the base, and on an empty map flat ground `standing_height` below z: what the
      simulator's scan reads there. See `ground.continue_ground`.
    - "original": what the preset's original reads where a ray hits nothing, a wall or a pit. Few policies saw that in
      training, where rays hit the terrain; a blind spot or a fresh map then looks like nothing they know.
    - "base": flat ground `standing_height` below z; "lowest": the lowest known ground under the environment's points;
      "upper_bound": the ground's bound by rays; "inpaint": means of known neighbours. Where one of these has no
      answer, "base" is taken.
    - a number: in place of z - elevation - nominal_height.

    Raises ValueError for settings out of range.
    """

    pattern: Points = field(repr=False)  #: (P, 2) [m]
    alignment: str = "yaw"  #: how the pattern turns with the robot: "yaw", "base" or "world"
    mode: str = "bilinear"  #: "bilinear" or "nearest" reading of the map
    nominal_height: float = 0.0  #: [m] of z over the ground; elsewhere called the offset
    clip: float | None = None  #: [m] values lie within +-clip before they are scaled
    scale: float = 1.0  #: factor on the values, last of all
    fill: str | float = "ground"  #: what unknown cells read: a rule's name, or a number [m]
    original: str | float = "base"  #: what fill="original" stands for: another rule, or a number
    standing_height: float | None = None  #: [m] of z over flat ground, where the map knows none; None: nominal_height
    inpaint_rings: int = 5  #: cells that "inpaint" reaches into what is unknown
    noise: float = 0.0  #: [m] half the width of the uniform noise that a call may ask for
    noise_after_clip: bool = False  #: add noise after clipping, as some simulators do, not before
    num_feet: int = 0  #: patterns around feet; 0: one around the base
    reach: float = 0.0  #: [m] how far from the base a foot may be
    _pattern: Pattern = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pattern", patterns.as_points(self.pattern))
        require_mode(self.mode)
        if self.clip is not None:
            require_positive(clip=self.clip)
        require_fill("fill", self.fill, (*FILLS, ORIGINAL), self.clip)
        require_fill("original", self.original, FILLS, self.clip)
        standing = self.standing_height
        good = standing is None or (isinstance(standing, int | float) and math.isfinite(standing))
        rule, hint = "must be a finite number or None", "give the base's height over the ground where the robot stands"
        require(good, "standing_height", rule, repr(standing), hint)
        for name in ("nominal_height", "scale", "noise", "reach", "num_feet", "inpaint_rings"):
            value, signed = getattr(self, name), name in ("nominal_height", "scale")
            kinds = int if name in ("num_feet", "inpaint_rings") else int | float
            good = isinstance(value, kinds) and math.isfinite(value) and (signed or value >= 0)
            rule = f"must be a finite{'' if signed else ', not negative'} {'int' if kinds is int else 'number'}"
            require(good, name, rule, repr(value), "leave it out for its default")
        object.__setattr__(self, "_pattern", Pattern(self.pattern, self.alignment, self.reach))

    # Patterns -------------------------------------------------------------------------------------------------------

    @classmethod
    def preset(cls, name: str, **settings: Any) -> HeightScan:
        """Build the preset of this name, which may come from a file or a command line."""
        require(name in PRESETS, "preset", f"must be one of {', '.join(PRESETS)}", repr(name), "use isaac_lab")
        return getattr(cls, name)(**settings)

    @classmethod
    def isaac_lab(
        cls, *, length_x: float = 1.6, length_y: float = 1.0, resolution: float = 0.1, **settings: Any
    ) -> HeightScan:
        """Build Isaac Lab's `height_scan`: clip(z - h - 0.5, +-1), x fastest: `values.view(B, 11, 17)`.

        Its pattern is arange(-l / 2, l / 2 + 1e-9, resolution): 1.1 m at 0.04 m are 28 points, the last at 0.53 m. Its
        scan of flat ground reads the base's height less 0.5 m; on an empty map this one reads `standing_height`, 0.5 m
        by default, less 0.5 m. A ray that hits nothing reads inf there, which clips to -1 as of a wall; so does
        `fill="original"`. The noise is U(+-0.1 m), before the clip.
        """
        require_positive(length_x=length_x, length_y=length_y, resolution=resolution)
        x, y = (steps(length, resolution, 1e-9) for length in (length_x, length_y))
        preset: dict[str, Any] = dict(nominal_height=0.5, clip=1.0, noise=0.1, original=-math.inf)
        return cls(pattern=patterns.x_fastest(x, y), **(preset | settings))

    @classmethod
    def mjlab(
        cls, *, length_x: float = 1.6, length_y: float = 1.0, resolution: float = 0.1, **settings: Any
    ) -> HeightScan:
        """Build mjlab's `height_scan`: (z - h) / 5, x fastest: `values.view(B, 11, 17)`.

        Its pattern is arange(-l / 2, l / 2 + resolution / 2, resolution), whose last point may lie farther out: 1.1 m
        at 0.04 m are 29 points, the last at 0.57 m. Its scan of flat ground reads the base's height / 5; on an empty
        map this one reads `standing_height` / 5, with 0.5 m by default: give your robot's. A ray that hits nothing
        reads its longest there, 5 m, so 1.0 as of a pit; so does `fill="original"`. The noise is U(+-0.1 m), before the
        scale.
        """
        require_positive(length_x=length_x, length_y=length_y, resolution=resolution)
        x, y = (steps(length, resolution, resolution * 0.5) for length in (length_x, length_y))
        preset: dict[str, Any] = dict(scale=1 / 5, noise=0.1, original=5.0, standing_height=0.5)
        return cls(pattern=patterns.x_fastest(x, y), **(preset | settings))

    @classmethod
    def legged_gym(
        cls,
        *,
        x: Sequence[float] = patterns.LEGGED_GYM_X,
        y: Sequence[float] = patterns.LEGGED_GYM_Y,
        **settings: Any,
    ) -> HeightScan:
        """Build legged_gym's `measured_heights`: 5 clip(z - 0.5 - h, +-1), y fastest: `values.view(B, 17, 11)`.

        `x` and `y` [m] are its measured_points_x and _y. It reads the lowest of three corners of its height field, 10
        cm apart by default; here they are cells, one `resolution` apart; `mode="bilinear"` reads the ground itself. It
        clamps indices, so that it misses nothing; `fill="original"` reads unknown ground as 0, as of flat ground. On an
        empty map the default reads 5 (`standing_height` - 0.5 m), with 0.5 m by default. The noise is U(+-0.1 m) after
        the clip, so that values reach +-5.5.
        """
        preset: dict[str, Any] = dict(mode="minimum", nominal_height=0.5, clip=1.0, scale=5.0, noise=0.1)
        return cls(pattern=patterns.y_fastest(x, y), **(preset | dict(noise_after_clip=True) | settings))

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
        """Build a grid around `offset` (x, y) [m]: whole steps, both ends included, y fastest as in layers."""
        n_x, n_y = whole_cells("length_x", length_x, resolution), whole_cells("length_y", length_y, resolution)
        x, y = (centered(n + 1, resolution, at) for n, at in zip((n_x, n_y), offset, strict=True))
        return cls(pattern=patterns.y_fastest(x, y), **settings)

    @classmethod
    def points(cls, xy: Any, **settings: Any) -> HeightScan:
        """Build a scan of any points (P, 2) [m], in their order: a tensor, an array or pairs."""
        return cls(pattern=xy, **settings)

    @classmethod
    def feet(
        cls,
        *,
        num_feet: int = 4,
        rings: Iterable[tuple[float, int]] = patterns.RINGS,
        reach: float = 0.6,
        **settings: Any,
    ) -> HeightScan:
        """Build rings of (radius [m], points) around each foot: by default five, of 52 points, as Miki et al. 2022.

        Points go foot by foot, ring by ring, from straight ahead to the left. A foot is at most `reach` [m] from the
        base.
        """
        require(num_feet != 0, "num_feet", "must be positive", num_feet, "use HeightScan.points around the base")
        return cls(pattern=patterns.ring_points(rings), num_feet=num_feet, reach=reach, **settings)

    @property
    def num_points(self) -> int:
        """P: how many values each environment has."""
        return len(self.pattern) * max(1, self.num_feet)

    # Reading --------------------------------------------------------------------------------------------------------

    def __call__(
        self,
        emap: ElevationMap,
        T_map_base: Float[Tensor, "B 4 4"],
        feet: Float[Tensor, "B K 3"] | None = None,
        *,
        noise: bool | Float[Tensor, "B P"] = False,
        state: MapState | None = None,
    ) -> tuple[Float[Tensor, "B P"], Bool[Tensor, "B P"]]:
        """Read values (B, P), filled where nothing is known, and where the elevation is known, (B, P) bool.

        Args:
            emap: the maps.
            T_map_base: the robots; float64 far from the origin.
            feet: map frame [m], for a scan around feet.
            noise: True draws it; a tensor in [0, 1), as of `torch.rand`, is what is drawn.
            state: read this in place of the map's own.

        Fresh tensors without NaN. Differentiable in the state and, if bilinear, in T_map_base and feet. The first call
        on a device copies the pattern to it: make one before capturing a CUDA graph. Raises ValueError or TypeError
        for inputs that do not fit, and for a window that the pattern does not fit into.
        """
        grid = emap.cfg.grid
        self._pattern.require_inside(grid)
        T_map_base = check_base(emap, T_map_base)
        middles = self._middles(emap, T_map_base, feet)
        u = self._draw(emap, noise)
        state = emap.state if state is None else state
        uv = self._pattern.place(T_map_base, middles, state.corner, grid.resolution, state.elevation.dtype)
        z = middles[..., 2:].to(uv.dtype)
        # On a GPU nobody has looked at the poses.
        z, finite = (v.expand(-1, -1, len(self.pattern)).flatten(1) for v in (z, torch.isfinite(z)))
        ((elevation, valid),) = read_points([(state.elevation, state.validity)], uv, grid, self.mode)
        valid, half = valid & finite, self._pattern.cells(grid)
        read = (elevation, valid)
        fill = self.original if self.fill == ORIGINAL else self.fill
        xyz = T_map_base[:, None, :3, 3]
        base = grid_coordinates(xyz, state.corner, grid.resolution, uv.dtype), xyz[..., 2].to(uv.dtype)
        ground, known = fill_unknown(fill, state, uv, base, read, grid, self.mode, half, self.inpaint_rings)
        missing = self._standing - self.nominal_height if isinstance(fill, str) else fill
        value = torch.where(known & finite, z - ground - self.nominal_height, missing)
        return self._finish(value, u), valid

    @property
    def _standing(self) -> float:
        return self.nominal_height if self.standing_height is None else self.standing_height

    def _finish(self, value: Tensor, u: Tensor | None) -> Tensor:
        """Apply noise, clip and scale."""
        error = None if u is None else (2 * u - 1) * self.noise
        if error is not None and not self.noise_after_clip:
            value = value + error
        if self.clip is not None:
            value = value.clamp(-self.clip, self.clip)
        if error is not None and self.noise_after_clip:
            value = value + error
        return value * self.scale

    def _middles(self, emap: ElevationMap, T_map_base: Tensor, feet: Tensor | None) -> Tensor:
        """Return what the pattern lies around: the base (B, 1, 3) or the feet (B, K, 3) [m]."""
        if not self.num_feet:
            require(feet is None, "feet", "must be left out", "feet for a scan around the base", "use HeightScan.feet")
            return T_map_base[:, None, :3, 3]
        shape = (emap.num_envs, self.num_feet, 3)
        hint = "give the feet's positions in the map frame"
        require(feet is not None, "feet", f"expected {shape}", "None", hint)
        value = checks.check_tensor("feet", feet, emap.device, checks.FLOATS)
        require(tuple(value.shape) == shape, "feet", f"expected {shape}", tuple(value.shape), hint)
        return value

    def _draw(self, emap: ElevationMap, noise: bool | Tensor) -> Tensor | None:
        """Return numbers (B, P) in [0, 1), or None without noise."""
        if noise is False:
            return None
        require(self.noise > 0, "noise", "must be off, as this scan has none", "on", "build it with noise=0.1")
        shape, dtype = (emap.num_envs, self.num_points), emap.elevation.dtype
        if noise is True:
            return torch.rand(shape, device=emap.device, dtype=dtype)
        value = checks.check_tensor("noise", noise, emap.device, checks.FLOATS)
        require(tuple(value.shape) == shape, "noise", f"expected {shape}", tuple(value.shape), "use torch.rand")
        return value.to(dtype)


def check_base(emap: ElevationMap, T_map_base: object) -> Tensor:
    """Return the robots' poses, one for each environment."""
    return checks.check_pose("T_map_base", T_map_base, (emap.num_envs, 4, 4), emap.device, emap.check_values)
