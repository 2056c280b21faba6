"""What each map has contributed to each site: of all sites of a process, so that one may be closed and opened again."""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from torchelev.site.fusion.windows import Contribution, drop_reset

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

_CONTRIBUTIONS: WeakKeyDictionary[ElevationMap, dict[str, Contribution]] = WeakKeyDictionary()  # by map and site


def keep(emap: ElevationMap, site: str, contribution: Contribution) -> None:
    """Remember what a map has contributed to the site of this id."""
    _CONTRIBUTIONS.setdefault(emap, {})[site] = contribution


def find(emap: ElevationMap, site: str) -> Contribution | None:
    """Return what a map has contributed to the site of this id; None: nothing."""
    return _CONTRIBUTIONS.get(emap, {}).get(site)


def recall(emap: ElevationMap, site: str) -> Contribution | None:
    """Return the same, without environments that were reset since; None: the map has not merged since."""
    contribution = find(emap, site)
    if contribution is None:
        return None
    device = contribution.elapsed.device
    return drop_reset(contribution, emap.num_resets.to(device), emap.state.elapsed.to(device))
