"""Find the parts of a simulator's scene that a term names, and refuse those that do not fit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from torch import Tensor

from torchelev.errors import require


def to_names(parameter: str, value: Any) -> tuple[str, ...]:
    """Return one name, or a list of names, as a tuple; a `SceneEntityCfg` counts by its `name`."""
    given = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    names: tuple[Any, ...] = tuple(getattr(item, "name", item) for item in given)
    are_names = len(names) > 0 and all(isinstance(name, str) for name in names)
    hint = f"set params={{{parameter!r}: ...}} of the term"
    require(are_names, parameter, "must name a part of the scene, or several in a list", repr(value), hint, TypeError)
    return names


def find(scene: Any, parameter: str, name: str, there: Iterable[str]) -> Any:
    """Return the part of the scene with this name; ValueError if there is none."""
    known = sorted(there)
    hint = "correct the name, or add it to the scene"
    require(name in known, parameter, f"must be one of {', '.join(known) or 'none'}", repr(name), hint)
    return scene[name]


def require_one_origin(parameter: str, name: str, starts: Tensor) -> None:
    """Refuse a ray sensor whose rays (..., N, 3) [m] do not all start at one point.

    The map clears what lies between a sensor's origin and its hits, which parallel rays did not pass through.
    """
    spread = float((starts - starts[..., :1, :]).abs().max())
    rule = f"the rays of {name!r} must start at one point, as those of cameras and lidars do"
    hint = "give it a pinhole or lidar pattern; parallel rays from above see the ground through everything"
    require(spread < 1e-6, parameter, rule, f"starts that are up to {spread:.3g} m apart", hint)
