"""The levels that a site keeps: their layers in its tiles, and how they are read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.levels import LAYERS as MADE
from torchelev.levels import views
from torchelev.levels.config import LevelsConfig
from torchelev.levels.state import SURFACE

if TYPE_CHECKING:
    from jaxtyping import Float

    from torchelev.site.content.reading import Clock

SPACE = ("space/free_top", "space/is_open")
SHARED = ("max_levels", "min_gap")  # settings that a site uses
_BY_LEVEL = ("elevation", "underside", "variance", "time")
_GROUND = ("elevation", "variance", "time", "upper_bound")


class SiteLevels:
    """The levels of a site: L = K - 1 surfaces of a cell besides its ground, which is the lowest one.

    Args:
        cfg: K and `min_gap`; the other settings are of no use to a site. None, or K = 1: no levels.

    Raises:
        TypeError: `cfg` is no LevelsConfig.
    """

    def __init__(self, cfg: LevelsConfig | None) -> None:
        hint = "give LevelsConfig(max_levels=3), for example"
        is_config = cfg is None or isinstance(cfg, LevelsConfig)
        require(is_config, "levels", "must be a LevelsConfig", type(cfg).__name__, hint, TypeError)
        self.cfg = cfg if cfg is not None and cfg.others else None
        rows = [f"surface{place}/{name}" for place in range(self.others) for name in SURFACE]
        #: The layers in the tiles: surfaces in no order, NaN where there is none, and the space above the ground.
        self.stored = (*rows, *SPACE) if self else ()

    @classmethod
    def of(cls, attributes: Mapping[str, Any]) -> SiteLevels:
        """Return the levels of a folder with these attributes; those without levels have none of them."""
        values = attributes.get("levels")
        return cls(None if values is None else LevelsConfig(**values))

    def require_alone(self, is_alone: bool) -> None:
        """Raise ValueError if there are any in a site that has keyframes, or a group of several processes."""
        hint = "merge in one process, without keyframes; or leave levels out, and the site keeps the ground alone"
        require(not self or is_alone, "levels, keyframes and group", "exclude each other", "several", hint)

    def require_same(self, wanted: SiteLevels) -> None:
        """Raise ValueError unless these are the wanted levels; nothing is checked if none are wanted."""
        for name in SHARED if wanted else ():
            own, given = (repr(getattr(levels.cfg, name, None)) for levels in (self, wanted))
            kept, hint = (
                "None: the site was begun without" if not self else own,
                "leave levels out, or begin another site",
            )
            rule = f"must be {kept}, as from the first merge on"
            require(own == given, f"levels.{name}", rule, given, hint)

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return self.cfg is not None

    @property
    def others(self) -> int:
        """L, surfaces of a cell besides its ground."""
        return 0 if self.cfg is None else self.cfg.others

    @property
    def max_difference(self) -> float:
        """Difference [m] beyond which heights of a cell belong to different surfaces; infinite without levels."""
        return math.inf if self.cfg is None else self.cfg.min_gap

    @property
    def attributes(self) -> dict[str, Any]:
        """The settings as JSON values; nothing without levels."""
        return {} if self.cfg is None else {"levels": asdict(self.cfg)}

    @property
    def layers(self) -> tuple[str, ...]:
        """The names by which they are read: those of level 0 are of the lowest surface of each cell."""
        names = (f"level{level}.{name}" for level in range(self.others + 1) for name in _BY_LEVEL)
        return (*MADE, *names) if self else ()

    @property
    def sources(self) -> tuple[str, ...]:
        """The layers in the tiles that they are read from."""
        return (*_GROUND, *self.stored)

    def compute(self, layer: str, stored: Mapping[str, Tensor], clock: Clock) -> Float[Tensor, "..."]:
        """Return a layer as it is read, NaN where unknown."""
        assert self.cfg is not None
        surfaces = self._view(stored, clock)
        if layer in MADE:
            values, known = getattr(views, layer)(surfaces, self.cfg.min_gap)
        else:
            level, _, name = layer.removeprefix("level").partition(".")
            values, known = views.by_level(name, int(level), surfaces)
        return torch.where(known, values, torch.nan)[0]

    def _view(self, stored: Mapping[str, Tensor], clock: Clock) -> views.View:
        """Return the ground and the other surfaces as of the site's time."""
        rows = {"lower": ["elevation"], "upper": ["elevation"], "variance": ["variance"], "time": ["time"]}
        others = [f"surface{place}" for place in range(self.others)]
        raw = {key: [stored[name] for name in (*first, *(f"{o}/{key}" for o in others))] for key, first in rows.items()}
        lower, upper, variance, time = (torch.stack(raw[key])[None] for key in rows)
        elevation, bound, top = (stored[name][None] for name in ("elevation", "upper_bound", SPACE[0]))
        known = ~time.isnan()
        floor = torch.where(known[:, 0], elevation, bound)
        return views.View(
            lower=lower.nan_to_num(nan=0.0),
            upper=upper.nan_to_num(nan=0.0),
            variance=variance + clock.rate * (clock.time - time),
            time=clock.time - time,
            known=known,
            floor=floor,
            has_floor=~floor.isnan(),
            free_top=top.nan_to_num(nan=-torch.inf),
        )
