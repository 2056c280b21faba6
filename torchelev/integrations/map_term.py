"""The part that observation terms of all simulators share: read the maps of an environment as an observation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan
from torchelev.errors import require
from torchelev.integrations.step_map import Source, StepMap, share_map

Reader = Callable[..., Any]
#: parameters of a term, and the settings of a HeightScan that they are
_SCAN_SETTINGS = {"standing_height": "standing_height", "miss_value": "fill"}
#: 3.2 m hold the 187 points of a height scan at every heading, and 0.6 m of walking between two updates
DEFAULT_CFG = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=3.2, length_y=3.2))


class MapTerm:
    """An observation term that reads elevation maps. Its settings are class attributes: subclass it to change them.

    Simulators turn the parameters of a term into YAML and back, in which only plain values survive.
    """

    #: a HeightScan, a MapImage, or a function of your own, (emap, T_map_base) -> (B, ...)
    read: ClassVar[Reader]
    map_cfg: ClassVar[ElevationMapConfig] = DEFAULT_CFG  #: config of the maps
    #: True appends the validity of a height scan: (B, P) becomes (B, 2 P), with channels (B, C, P) becomes (B, 2 C, P)
    with_validity: ClassVar[bool] = False

    maps: StepMap  #: the maps, and the simulator that they are of
    _reader: Reader
    _source: Source

    def _set_up(self, cfg: Any, env: Any, source: Source) -> None:
        """Find or make the maps, and check that the term's config and the reader fit together."""
        self._reader = _choose_reader(type(self).read, cfg.params)
        _refuse_second_scale(cfg, self._reader)
        self._source = source  # shared maps keep that of the first term, which may not know the feet
        self.maps = share_map(env, source, type(self).map_cfg, cfg.params.get("update_every", 1))

    @property
    def emap(self) -> ElevationMap:
        """The maps, for instance to read layers, to save them or to compile their updates."""
        return self.maps.emap

    def reset(self, env_ids: Any = None) -> None:
        """Forget the maps of environments that restart; the manager calls it."""
        self.maps.reset(env_ids)

    @torch.no_grad()
    def _observe(self, env: Any) -> Tensor:
        """Update the maps if they are due, and read them: a fresh tensor (B, ...) in float32 without NaN."""
        self.maps.advance(env)
        emap = self.emap
        if self.maps.is_empty:
            # The manager asks for the shape before there is data: read the empty maps around the origin.
            T_map_base = torch.eye(4, device=emap.device).repeat(emap.num_envs, 1, 1)
        else:
            T_map_base = self.maps.source.read_base(env)
        values = self._reader(emap, T_map_base, *self._read_feet(env))
        if isinstance(values, tuple):
            values = torch.cat([part.float() for part in values], 1) if self.with_validity else values[0]
        _check_shape(values, emap.num_envs)
        return torch.where(values.isfinite(), values, 0.0).float()

    def _read_feet(self, env: Any) -> tuple[Tensor, ...]:
        """Return the positions of the feet (B, K, 3), for a scan around feet; else nothing."""
        if not isinstance(self._reader, HeightScan) or not self._reader.num_feet:
            return ()
        if self.maps.is_empty:
            return (torch.zeros(self.emap.num_envs, self._reader.num_feet, 3, device=self.emap.device),)
        return (self._source.read_feet(env),)


def _choose_reader(read: Reader, params: dict[str, Any]) -> Reader:
    """Return the reader, with the settings of a height scan that the term's parameters give."""
    require(callable(read), "read", "must be callable", type(read).__name__, "set it to a HeightScan or a MapImage")
    given = {name: params[name] for name in _SCAN_SETTINGS if params.get(name) is not None}
    for name, value in given.items():
        hint = "leave it out, or read a HeightScan"
        require(isinstance(read, HeightScan), name, "needs a HeightScan", type(read).__name__, hint)
        is_number = isinstance(value, int | float) and math.isfinite(value)
        require(is_number, name, "must be a finite number [m]", repr(value), "leave it out for the setting of read")
    settings = {_SCAN_SETTINGS[name]: value for name, value in given.items()}
    return dataclasses.replace(read, **settings) if given else read  # type: ignore[type-var]


def _refuse_second_scale(cfg: Any, read: Reader) -> None:
    """Refuse a scale or noise of the term's config for a scan that is scaled itself."""
    if not isinstance(read, HeightScan) or read.scale == 1.0:
        return
    for name in ("scale", "noise"):
        given = getattr(cfg, name, None)
        rule = f"must be left out, as the height scan multiplies by {read.scale:g} itself"
        require(given is None, name, rule, given, "leave it out, or set read to a scan with scale=1.0")


def _check_shape(values: Any, num_envs: int) -> None:
    fits = isinstance(values, Tensor) and values.ndim > 1 and values.shape[0] == num_envs
    actual = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
    require(fits, "read", f"must return a tensor ({num_envs}, ...)", actual, "give one row for each environment")
