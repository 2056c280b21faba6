"""The values that points bring for channels, and the checks that they pass before anything changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.channels.config import ChannelConfig
from torchelev.errors import require
from torchelev.inputs.checks import FLOATS, check_tensor
from torchelev.ops.transforms import is_readable

if TYPE_CHECKING:
    from jaxtyping import Float

_TOLERANCE = 1e-2  # of sums of probabilities, which may come in half precision


def find_channel(name: object, channels: Mapping[str, ChannelConfig], argument: str) -> ChannelConfig:
    """Return the channel of this name; KeyError if there is none."""
    known = ", ".join(channels) or "none: give the config channels={...}"
    require(name in channels, argument, f"must name channels of the map: {known}", repr(name), "correct it", KeyError)
    return channels[name]  # type: ignore[index]


def check_features(
    features: Any, points: Tensor, channels: Mapping[str, ChannelConfig], device: torch.device
) -> dict[str, Float[Tensor, "B M C"]]:
    """Return the values of the points by channel, in float32.

    Args:
        features: by channel, (..., C) or, of one component, (...), with the leading dimensions of `points`.
        points: (..., 3), as the caller gave them.
        channels: of the map.
        device: of the map.

    Raises:
        TypeError, ValueError, KeyError: a channel is not there, or its values do not fit.
    """
    if features is None:
        return {}
    hint = 'give {"rgb": (B, N, 3)}'
    is_mapping = isinstance(features, Mapping)
    require(is_mapping, "features", "must be a dict by channel", type(features).__name__, hint, TypeError)
    lead = tuple(points.shape[:-1])
    return {name: _check_values(f"features[{name!r}]", value, lead, find_channel(name, channels, "features"), device)
            for name, value in features.items()}  # fmt: skip


def _check_values(
    where: str, value: Any, lead: tuple[int, ...], cfg: ChannelConfig, device: torch.device
) -> Float[Tensor, "B M C"]:
    kinds = (*FLOATS, torch.uint8) if cfg.is_color else FLOATS
    labels = (
        f"give probabilities, such as one_hot(labels, {cfg.size}).float()" if cfg.kind.startswith("class") else None
    )
    value = check_tensor(where, value, device, kinds, labels)
    expected = (*lead, cfg.size)
    fits = tuple(value.shape) == expected or (cfg.size == 1 and tuple(value.shape) == lead)
    require(fits, where, f"expected {expected}", tuple(value.shape), "give the values of each point")
    value = value.reshape(lead[0], -1, cfg.size)
    value = value.float() / 255 if value.dtype == torch.uint8 else value.float()
    if is_readable(value):
        require_values(where, value.detach(), cfg)
    return value


def require_values(where: str, value: Float[Tensor, "... C"], cfg: ChannelConfig) -> None:
    """Refuse colours that are not from 0 to 1, and probabilities that do not sum to 1; NaN is no value."""
    if cfg.is_color and value.numel():
        lowest, highest = (float(limit) for limit in value.aminmax())
        if not (lowest >= 0 and highest <= 1):  # NaN if any value is
            wrong = (value < 0) | (value > 1)
            rule, hint = "must be colours from 0 to 1", "divide by 255, or give uint8"
            require(not bool(wrong.any()), where, rule, _first(value, wrong.any(-1)), hint)
    if cfg.kind.startswith("class"):
        total = value.sum(-1)
        wrong = ((total - 1).abs() > _TOLERANCE) | (value < -_TOLERANCE).any(-1)
        rule, hint = f"must be probabilities of {cfg.size} classes that sum to 1", "apply softmax, or one_hot to labels"
        require(not bool(wrong.any()), where, rule, _first(value, wrong), hint)


def _first(value: Tensor, wrong: Tensor) -> str:
    return "" if not wrong.any() else ", ".join(f"{number:.3g}" for number in value[wrong][0].tolist())
