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
    same_settings: dict[str, Any] | None = None  #: which compute what that package does; None: these do
    same_note: str = ""  #: what differs with them


_DIVIDED = "is the mean over the points of a cell; there, their sum is divided by the number of accepted ones"
_OWN_CHANNEL = "is one channel for each class"

FUSIONS: dict[str, Fusion] = {
    "color": Fusion(
        {"kind": "color"},
        "is the mean over all updates here, that of the newest there",
        {"kind": "exponential", "rate": 1.0, "names": COLORS},
    ),
    "average": Fusion(
        {"kind": "exponential", "rate": 1.0},
        "points far from the cell's height do not count here; there they do",
        same_note=_DIVIDED,
    ),
    "exponential": Fusion({"kind": "exponential", "rate": 0.7}),
    "class_average": Fusion({"kind": "exponential"}, _OWN_CHANNEL, same_note=f"{_OWN_CHANNEL}, and {_DIVIDED}"),
    "class_bayesian": Fusion(
        {"kind": "mean"},
        f'{_OWN_CHANNEL}; give ChannelConfig(kind="class", names=...) for all of them',
        same_note=f"{_OWN_CHANNEL}, and a mean; there it is the newest update's share of all classes",
    ),
    "class_max": Fusion(
        {"kind": "exponential", "rate": 1.0},
        "keeps the probability of this class alone",
        same_note="keeps the probability of this class alone",
    ),
    "bayesian_inference": Fusion(
        {"kind": "mean"}, "its prior starts anew with each update there", same_note="its prior starts anew there"
    ),
}
#: Rules of a file that has none.
DEFAULTS = {
    "pointcloud_channel_fusions": {"rgb": "color", "default": "class_average"},
    "image_channel_fusions": {"rgb": "color", "default": "exponential"},
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
        given = {str(pattern): str(kind) for pattern, kind in (fusions.get(group) or {}).items()}
        named = [name for name in given if name.isidentifier() and name not in ("default", "none")]
        rules = given if group in fusions else DEFAULTS[group]
        for name in dict.fromkeys((*named, *sent)):
            rule = next((kind for pattern, kind in rules.items() if re.fullmatch(pattern, name)), rules.get("default"))
            if rule is None or rule == "none" or name in channels:
                continue
            require(rule in FUSIONS, f"{group}.{name}", f"must be one of {', '.join(FUSIONS)}", rule, "correct it")
            channels[name], note = _channel(rule, average_weight, every_point)
            notes += [f"channel {name}, {rule}: {note}"] if note else []
    left_out = [name for name in sent if name not in channels]
    notes += [f"channel {name}: no rule of {' or '.join(GROUPS)} fits, so that it is left out" for name in left_out]
    return channels, notes


def _channel(rule: str, average_weight: float, every_point: bool) -> tuple[ChannelConfig, str]:
    """Return the channel of a rule, and what differs."""
    fusion = FUSIONS[rule]
    settings = dict(fusion.same_settings or fusion.settings if every_point else fusion.settings)
    if rule == "class_average":
        settings["rate"] = 1 - average_weight
    if every_point:
        settings["tolerance"] = ANY_HEIGHT
    return ChannelConfig(**settings), fusion.same_note if every_point else fusion.note
