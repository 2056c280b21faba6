"""The settings of channels."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from torchelev.errors import require

KINDS = ("mean", "exponential", "maximum", "color", "class", "class_average", "feature")  # `Kind` of equation.h
DTYPES = ("float32", "float16")
COLORS = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True)
class ChannelConfig:
    """What one channel holds of each cell, and how it is fused.

    `kind` says how the values x_i of the points of an update, or of a painted image, become the cell's value v. W is
    the evidence that the cell has, 0 at first.

    - "mean": v = sum w_i x_i / sum w_i over all updates, with w_i = (1 cm)^2 / sigma_i^2 of the point's height.
    - "color": the same, of red, green and blue from 0 to 1.
    - "feature": the same, of vectors; what is read has length 1 if `normalize`.
    - "exponential": v = (1 - rate) v + rate m, with the mean m of the update's points; v = m at first.
    - "maximum": the largest value ever.
    - "class": probabilities of classes by Bayes: v = (a_c + prior / C) / (W + prior) with the Dirichlet counts
      a_c = sum p_ic of the points' probabilities.
    - "class_average": probabilities as in "exponential".

    A point counts if it lies within `tolerance` of the cell's elevation after the update: a channel is that of the
    ground which the map shows, not of a branch above it. What forgets a cell's elevation forgets its channels, and so
    does ground that rises or falls by more than `tolerance` between two updates: an obstacle brings its own.

    Raises:
        ValueError: a setting is out of range.
    """

    kind: str = "mean"  #: kind of the channel, one of KINDS
    #: names of the components or classes; ("red", "green", "blue") makes any kind a colour
    names: tuple[str, ...] = ()
    size: int = 0  #: C, number of components; 0: the number of `names`, 3 for a colour, otherwise 1
    rate: float = 0.7  #: weight of a new mean in "exponential" and "class_average"
    prior: float = 1.0  #: weight of the uniform prior over all classes, in points
    normalize: bool = True  #: normalise features to length 1 on reading
    half_life: float | None = None  #: [s] time in which the evidence halves, so that new points count more; None: never
    max_age: float | None = None  #: [s] time after which a cell that is no longer seen is forgotten; None: never
    tolerance: float = 0.05  #: [m] maximum height difference from the elevation, see above
    dtype: str = "float32"  #: type of the stored values, "float32" or "float16"

    def __post_init__(self) -> None:
        is_list = isinstance(self.names, list | tuple)
        require(is_list, "channel.names", "must be a list of names", repr(self.names), 'give ("grass", "stone")')
        object.__setattr__(self, "names", tuple(self.names))
        kinds = f"must be one of {', '.join(KINDS)}"
        require(self.kind in KINDS, "channel.kind", kinds, repr(self.kind), "see ChannelConfig")
        require(
            self.dtype in DTYPES, "channel.dtype", f"must be one of {', '.join(DTYPES)}", repr(self.dtype), "float32"
        )
        names = self.names or (COLORS if self.kind == "color" else ())
        size = self.size or len(names) or 1
        is_number = isinstance(size, int) and size > 0
        require(is_number, "channel.size", "must be a positive int", repr(self.size), "give the number of components")
        fits = not names or len(names) == size
        require(fits, "channel.names", f"must name the {size} components", names, "leave size or names out")
        are_names = all(isinstance(name, str) and name and "." not in name for name in names)
        require(are_names and len(set(names)) == len(names), "channel.names", "must be different words without dots",
                names, "rename them")  # fmt: skip
        is_vector = self.kind != "feature" or size > 1
        require(is_vector, "channel.size", "must be two or more of a vector", size, 'give size=64, or kind="mean"')
        is_color, hint = self.kind != "color" or size == 3, "leave size and names out"
        require(is_color, "channel.size", "must be 3 of a colour", size, hint)
        has_classes = not self.kind.startswith("class") or size > 1
        require(has_classes, "channel.size", "must be two or more of classes", size, 'give names=("grass", "stone")')
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "size", size)
        fits, hint = self.kind != "class" or self.dtype == "float32", "use float32"
        require(fits, "channel.dtype", "must be float32 for counts, which float16 cannot hold", self.dtype, hint)
        self._require_number("rate", "must lie in (0, 1]", "give 0.7", 1.0)
        for name, unit in (
            ("tolerance", "metres"),
            ("prior", "points"),
            ("half_life", "seconds"),
            ("max_age", "seconds"),
        ):
            if getattr(self, name) is not None or name in ("tolerance", "prior"):
                self._require_number(name, "must be a positive number", f"give {unit}")

    def _require_number(self, name: str, rule: str, hint: str, most: float = math.inf) -> None:
        value = getattr(self, name)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        require(is_number and 0 < value <= most, f"channel.{name}", rule, repr(value), hint)

    @property
    def is_weighted(self) -> bool:
        """Whether points count by the variance of their heights."""
        return self.kind in ("mean", "color", "feature")

    @property
    def is_newest(self) -> bool:
        """Whether new values replace old ones by and by, so that the newest counts most."""
        return self.kind in ("exponential", "class_average")

    @property
    def is_color(self) -> bool:
        """Whether the components are red, green and blue, from 0 to 1: of "color", or by their names."""
        return self.names == COLORS and not self.kind.startswith("class")

    def components(self, name: str) -> tuple[str, ...]:
        """Return the layers of a channel of this name: itself, or `<name>.<component>` of each of several."""
        if self.size == 1 and not self.names:
            return (name,)
        return tuple(f"{name}.{part}" for part in (self.names or map(str, range(self.size))))


class ChannelConfigs(dict[str, ChannelConfig]):
    """The channels of a map by name. It can be hashed, and is not to be changed."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))


def parse_channels(channels: Any, layers: tuple[str, ...]) -> ChannelConfigs:
    """Return the channels of a config; a word stands for the channel of that kind with its defaults.

    Args:
        channels: settings by name: objects, words or dicts.
        layers: names that are taken.

    Raises:
        TypeError, ValueError: if it is no mapping, a name is taken, or a setting is unknown or out of range.
    """
    hint = 'give {"rgb": ChannelConfig(kind="color")}'
    is_mapping = isinstance(channels, Mapping)
    require(is_mapping, "cfg.channels", "must be a dict by name", type(channels).__name__, hint, TypeError)
    for name in channels:
        is_free = isinstance(name, str) and name.isidentifier() and name not in layers
        rule = "must have names that are words, and no layers of the map"
        require(is_free, "cfg.channels", rule, repr(name), "rename it")
    return ChannelConfigs({name: _parse(name, value) for name, value in channels.items()})


def expand_names(names: Iterable[str], channels: Mapping[str, ChannelConfig], argument: str) -> tuple[str, ...]:
    """Return the layers that names of channels, or of their components, stand for; errors call the names `argument`.

    Raises:
        KeyError: a name is neither.
    """
    hint = f"there are {', '.join(channels) or 'none: give the config channels={...}'}"
    layers: list[str] = []
    for name in names:
        channel = name.split(".")[0]
        require(channel in channels, argument, "must name channels of the map", repr(name), hint, KeyError)
        components = channels[channel].components(channel)
        is_known, rule = name == channel or name in components, f"must be components of {channel}"
        require(is_known, argument, rule, repr(name), f"there are {', '.join(components)}", KeyError)
        layers.extend(components if name == channel else (name,))
    return tuple(layers)


def _parse(name: str, value: Any) -> ChannelConfig:
    where = f"cfg.channels[{name!r}]"
    if isinstance(value, ChannelConfig):
        return value
    settings = {"kind": value} if isinstance(value, str) else value
    hint = "give a ChannelConfig"
    require(isinstance(settings, dict), where, "must be a ChannelConfig", type(value).__name__, hint, TypeError)
    known = [field.name for field in dataclasses.fields(ChannelConfig)]
    for setting in settings:
        require(
            setting in known, f"{where}.{setting}", "is not a setting", repr(setting), f"there are {', '.join(known)}"
        )
    try:
        return ChannelConfig(**settings)
    except (ValueError, TypeError) as error:
        raise type(error)(f"{where}: {error}") from error
