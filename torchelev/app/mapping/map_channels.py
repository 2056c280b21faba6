"""The channels that `--colour` and `--semantic` give to a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from torchelev.channels.config import ChannelConfig
from torchelev.errors import require
from torchelev.io import Recording
from torchelev.io.mapping import COLOR, SEMANTIC

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig

_OPTIONS = {COLOR: "--colour", SEMANTIC: "--semantic"}


def wanted_channels(
    colour: bool, num_classes: int | None = None, names: tuple[str, ...] = ()
) -> dict[str, ChannelConfig]:
    """Return the channels of what was asked for.

    Args:
        colour: fuse the colours of the points.
        num_classes: of the labels of images; None: there are none.
        names: of the classes; (): numbers.
    """
    wanted = {COLOR: ChannelConfig(kind="color")} if colour else {}
    if num_classes is not None:
        wanted[SEMANTIC] = ChannelConfig(kind="class", names=names, size=num_classes)
    return wanted


def add_channels(config: ElevationMapConfig, wanted: Mapping[str, ChannelConfig]) -> ElevationMapConfig:
    """Return a config with further channels; those that it has already keep their settings.

    Raises:
        ValueError: a channel of the config is of another kind or size.
    """
    for name, cfg in wanted.items():
        own = config.channels.get(name, cfg)
        is_kind = own.is_color if cfg.is_color else own.kind.startswith(cfg.kind)
        fits = is_kind and own.size >= cfg.size and cfg.names in ((), own.names)
        rule = f"must be of kind {cfg.kind} and have {_parts(cfg)}, as {_OPTIONS[name]} brings them"
        require(fits, f"config.channels.{name}", rule, f"{own.kind} with {_parts(own)}", "correct it, or leave it out")
    return replace(config, channels={**wanted, **config.channels}) if wanted else config


def _parts(cfg: ChannelConfig) -> str:
    return ", ".join(cfg.names) or f"{cfg.size} components"


def require_colors(scans: Recording) -> None:
    """Raise ValueError unless the points of a folder's first scan have colours."""
    first = scans[0]
    hint = "save fields red, green and blue, or rgb, in .ply or .pcd files, or leave --colour out"
    require(first.colors is not None, "--colour", "must find colours of the points", f"none in {first.name}", hint)
