"""The channels that points and images bring, by how they are fused."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from torchelev.channels.config import COLORS, ChannelConfig
from torchelev.errors import require

GROUPS = ("pointcloud_channel_fusions", "image_channel_fusions")
ANY_HEIGHT = 1e6  # [m]


class Fusion(NamedTuple):
    """What becomes of a fusion."""

    settings: dict[str, Any]  #: of the `ChannelConfig`
    note: str = ""  #: what differs
    same: dict[str, Any] | None = None  #: settings that compute what that package does, where they are others


FUSIONS: dict[str, Fusion] = {
    "color": Fusion(
        {"kind": "color"},
        "is the mean over all updates here, that of the newest there",
        {"kind": "exponential", "rate": 1.0, "names": COLORS},
    ),
    "average": Fusion({"kind": "exponential", "rate": 1.0}, "outliers do not count here; there they do in the sum"),
    "exponential": Fusion({"kind": "exponential", "rate": 0.7}),
    "class_average": Fusion({"kind": "exponential"}, "is one channel for each class"),
    "class_bayesian": Fusion(
        {"kind": "mean"}, 'is one channel for each class; give ChannelConfig(kind="class", names=...) for all of them'
    ),
    "class_max": Fusion({"kind": "exponential", "rate": 1.0}, "keeps the probability of this class alone"),
    "bayesian_inference": Fusion({"kind": "mean"}, "its prior starts anew with each update there"),
}


def read_channels(
    fusions: Mapping[str, Any], sent: tuple[str, ...], average_weight: float, every_point: bool
) -> tuple[dict[str, Any], list[str]]:
    """Return the channels: those that a fusion names, and those that sensors send, by the first rule that fits.

    With `every_point`, points at any height above or below their cell count, as there.
    """
    channels: dict[str, Any] = {}
    notes: list[str] = []
    for group in GROUPS:
        rules = {str(pattern): str(kind) for pattern, kind in (fusions.get(group) or {}).items()}
        named = [name for name in rules if name.isidentifier() and name not in ("default", "none")]
        for name in dict.fromkeys((*named, *sent)):
            rule = next((kind for pattern, kind in rules.items() if re.fullmatch(pattern, name)), rules.get("default"))
            if rule is None or rule == "none" or name in channels:
                continue
            require(rule in FUSIONS, f"{group}.{name}", f"must be one of {', '.join(FUSIONS)}", rule, "correct it")
            kind = FUSIONS[rule]
            settings = (every_point and kind.same or kind.settings) | (
                {"rate": 1 - average_weight} if rule == "class_average" else {}
            )
            channels[name] = ChannelConfig(**settings | ({"tolerance": ANY_HEIGHT} if every_point else {}))
            if kind.note:
                notes.append(f"channel {name}, {rule}: {kind.note}")
    return channels, notes
