"""The settings of a height scan: pattern, value and what unknown cells read."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torchelev.config import ElevationMapConfig
from torchelev.errors import require, require_positive
from torchelev.observations.channel_reading import count_rows, parse_channels
from torchelev.observations.fill import FILLS, ORIGINAL, require_fill, require_mode
from torchelev.observations.patterns import Pattern, Points, parse_points

SURFACES = ("ground", "ceiling")


@dataclass(frozen=True, kw_only=True)
class ScanSettings:
    """Settings of a `HeightScan`, with the defaults of `grid`, `points` and `feet`.

    `fill` chooses what the points over unknown cells read:

    - "ground", the default: the known ground continues (`ground.continue_ground`): the mean of the known cells nearby,
      farther away flat ground as high as below the base, and on an empty map flat ground `standing_height` below z.
      This is closest to what a scan in simulation reads there.
    - "original": what the original observation reads where a ray hits nothing: a wall or a pit. In training nearly
      all rays hit the terrain, so a blind spot then looks like nothing that the policy has seen.
    - "base": flat ground `standing_height` below z.
    - "lowest": the lowest known ground under the points of that environment.
    - "upper_bound": the upper bound of the ground from rays that passed over it.
    - "inpaint": means of known neighbours, `inpaint_rings` cells into the unknown area.
    - a number [m]: replaces z - elevation - nominal_height.

    Points for which "lowest", "upper_bound" or "inpaint" have no height read as with "base".

    `surface="ceiling"` reads what is above instead, on maps with levels:

    value = scale * clip(min(ceiling - z, no_ceiling) + noise, -clip, clip), by the lowest of the cells around a point.

    `channels` adds what else the map holds at the points, each read in the cell that holds the point, without scale,
    clip and noise: the heights are then the first of 1 + C rows.

    Raises:
        ValueError: for a setting out of range.
    """

    pattern: Points = field(repr=False)  #: (P, 2) [m] points in the aligned frame, in the order of the values
    #: "yaw" turns the pattern with the base's heading; "base" turns it in 3D and drops z; "world" only moves it
    alignment: str = "yaw"
    #: how the map is read: "bilinear", "nearest", or "minimum", legged_gym's lowest of three cells (`fill.read_points`)
    mode: str = "bilinear"
    nominal_height: float = 0.0  #: [m] offset subtracted from the height of the base or foot over the ground
    clip: float | None = None  #: [m] values are clipped to +-clip before they are scaled; None does not clip
    scale: float = 1.0  #: factor on the values, applied last
    fill: str | float = "ground"  #: value of unknown cells: the name of a rule, or a number [m]
    original: str | float = "base"  #: meaning of fill="original": another rule, or a number [m]
    standing_height: float | None = None  #: [m] of the robot's z over unknown flat ground; None means nominal_height
    inpaint_rings: int = 5  #: [cells] how far "inpaint" reaches into the unknown area
    noise: float = 0.0  #: [m] half the width of the uniform noise that a call can ask for
    noise_after_clip: bool = False  #: True adds the noise after the clip, as legged_gym does, not before it
    num_feet: int = 0  #: number of feet with a pattern around each; 0 puts one pattern around the base
    reach: float = 0.0  #: [m] largest horizontal distance of a foot from the base: the window must hold its pattern
    #: of the map's config, by name: "rgb" for all its components, or "terrain.stone" for one
    channels: tuple[str, ...] = ()
    channel_fill: float = 0.0  #: value of channels in cells where they are unknown
    #: "ground", or "ceiling": the height of the ceiling above z, on maps with levels; `clip` and `no_ceiling` limit it
    surface: str = "ground"
    no_ceiling: float = 2.0  #: [m] above z: read where the ceiling is unknown, higher, or not there
    placement: Pattern = field(init=False, repr=False, compare=False)  #: the pattern as it moves with the robot

    def __post_init__(self) -> None:
        object.__setattr__(self, "pattern", parse_points(self.pattern))
        require_mode(self.mode)
        if self.clip is not None:
            require_positive(clip=self.clip)
        require_fill("fill", self.fill, (*FILLS, ORIGINAL), self.clip)
        require_fill("original", self.original, FILLS, self.clip)
        standing = self.standing_height
        in_range = standing is None or (isinstance(standing, int | float) and math.isfinite(standing))
        rule, hint = "must be a finite number or None", "give the base's height over the ground where the robot stands"
        require(in_range, "standing_height", rule, repr(standing), hint)
        for name in ("nominal_height", "scale"):
            self._require_number(name, (int, float), "must be a finite number", -math.inf)
        known = self.surface in SURFACES
        require(known, "surface", f"must be one of {', '.join(SURFACES)}", repr(self.surface), "check its spelling")
        for name in ("noise", "reach", "no_ceiling"):
            self._require_number(name, (int, float), "must be a finite number of at least 0", 0)
        for name in ("num_feet", "inpaint_rings"):
            self._require_number(name, (int,), "must be an int of at least 0", 0)
        object.__setattr__(self, "channels", parse_channels(self.channels, self.channel_fill))
        object.__setattr__(self, "placement", Pattern(self.pattern, self.alignment, self.reach))

    def _require_number(self, name: str, types: tuple[type[int] | type[float], ...], rule: str, minimum: float) -> None:
        value = getattr(self, name)
        in_range = isinstance(value, types) and math.isfinite(value) and value >= minimum
        require(in_range, name, rule, repr(value), "leave it out for its default")

    @property
    def num_points(self) -> int:
        """P, the number of points of each environment, and of its values in a scan without channels."""
        return len(self.pattern) * max(1, self.num_feet)

    def shape_on(self, cfg: ElevationMapConfig) -> tuple[int, ...]:
        """Return the shape of each environment's values on maps of a config: (P,), or (1 + C, P) with channels.

        Raises:
            KeyError: if a channel is not there.
        """
        rows = (1 + count_rows(self.channels, cfg),) if self.channels else ()
        return (*rows, self.num_points)
