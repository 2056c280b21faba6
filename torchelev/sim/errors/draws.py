"""Domain randomisation: at reset, each environment draws its own values from the ranges of a config."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchelev.errors import require, require_count
from torchelev.inputs import checks

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

Range = float | tuple[float, float]  # one value for all environments, or (low, high) to draw from uniformly


def range_limits(value: Range) -> tuple[float, float]:
    """Return the smallest and the largest value of a range."""
    low, high = value if isinstance(value, tuple) else (value, value)
    return float(low), float(high)


def check_range(name: str, value: Any, min_value: float = 0.0, max_value: float = math.inf) -> None:
    """Require a number or a pair (low, high) of numbers, from `min_value` to `max_value`."""
    pair = value if isinstance(value, tuple) else (value, value)
    is_numeric = len(pair) == 2 and all(isinstance(v, int | float) and math.isfinite(v) for v in pair)
    require(is_numeric, name, "must be finite: a number or two", repr(value), "give one value or a pair (low, high)")
    fits = min_value <= pair[0] <= pair[1] <= max_value
    rule = f"must have {min_value:g} <= low <= high <= {max_value:g}"
    require(fits, name, rule, repr(value), "give one value or a pair (low, high) within these limits")


def _split_kinds(cfg: Any, config_type: type) -> tuple[list[float], list[Any]]:
    """Return the shares and the configs of the kinds of episodes; a single config is the only kind."""
    kinds: Sequence[Any] = cfg if isinstance(cfg, list | tuple) else ((1.0, cfg),)
    has_configs = all(isinstance(kind, tuple) and len(kind) == 2 and isinstance(kind[1], config_type) for kind in kinds)
    name = config_type.__name__
    require(has_configs, "cfg", f"must be a {name} or pairs (share, {name})", repr(cfg), f"make a {name}", TypeError)
    shares = [float(share) for share, _ in kinds]
    is_distribution = min(shares, default=-1.0) >= 0 and abs(sum(shares) - 1) < 1e-6
    require(is_distribution, "cfg", "must have shares that sum to 1", shares, "give pairs (share, config)")
    return shares, [config for _, config in kinds]


class DomainRandomization(nn.Module):
    """Values of a config's fields for B environments: drawn at reset, constant until the next one.

    Args:
        cfg: One config, or several kinds of episodes as pairs (share, config). At reset, an environment draws its kind
            with the probabilities `share`, then each value uniformly from the range in that kind's config.
        num_envs: B.
        device: Where values are stored and random numbers drawn. `.to()` moves the values and restarts the generator
            from the seed.
        seed: The same seed and the same calls give bitwise equal values on the same kind of device.

    Raises:
        TypeError: `cfg` is of another type.
        ValueError: The shares do not sum to 1, or `num_envs` is not positive.
    """

    config_type: type  # of `cfg`
    integer_fields: tuple[str, ...] = ()  # drawn as integers, both limits included
    low: Tensor
    high: Tensor
    share_limits: Tensor
    values: Tensor

    def __init__(self, cfg: Any, num_envs: int, device: torch.device | str = "cpu", seed: int = 0) -> None:
        super().__init__()
        shares, configs = _split_kinds(cfg, self.config_type)
        self.num_envs = require_count("num_envs", num_envs, "give the number of environments")
        self.cfg, self.seed = cfg, seed
        self.names = [field.name for field in fields(configs[0])]
        ranges = torch.tensor([[range_limits(getattr(config, name)) for name in self.names] for config in configs])
        self._in_use = {name for name, r in zip(self.names, ranges.unbind(1), strict=True) if bool((r != 0).any())}
        self._max_values = dict(zip(self.names, ranges[..., 1].amax(0).tolist(), strict=True))
        self.register_buffer("low", ranges[..., 0].to(device), persistent=False)
        self.register_buffer("high", ranges[..., 1].to(device), persistent=False)
        self.register_buffer("share_limits", torch.tensor(shares).cumsum(0)[:-1].to(device), persistent=False)
        self.register_buffer("values", torch.zeros(num_envs, len(self.names), device=device))
        self.generator = torch.Generator(device).manual_seed(seed)

    @property
    def device(self) -> torch.device:
        """Where the values are stored."""
        return self.values.device

    def value(self, name: str, dims: int = 1) -> Tensor:
        """Return a field's values (B, 1, ..., 1), of `dims` dimensions."""
        return self.values[:, self.names.index(name)].view(-1, *[1] * (dims - 1))

    def columns(self, *names: str) -> Tensor:
        """Return the values of several fields (B, len(names))."""
        return torch.stack([self.value(name) for name in names], -1)

    def uses(self, *names: str) -> bool:
        """Return whether any of the fields can be drawn different from 0."""
        return not self._in_use.isdisjoint(names)

    def max_value(self, name: str) -> float:
        """Return the largest value of a field that can be drawn."""
        return self._max_values[name]

    def uniform(self, *shape: int) -> Tensor:
        """Draw from the uniform distribution between 0 and 1."""
        return torch.rand(shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        """Draw from the standard normal distribution."""
        return torch.randn(shape, generator=self.generator, device=self.device)

    def reset(self, env_ids: Int[Tensor, "K"] | None = None, *, mask: Bool[Tensor, "B"] | None = None) -> None:
        """Draw new values for some environments, or for all.

        Args:
            env_ids: Environments to reset.
            mask: Which environments to reset; needs no host synchronisation.

        Raises:
            ValueError: Both are given, or one of them does not fit.
        """
        require(env_ids is None or mask is None, "env_ids, mask", "exclude each other", "both", "give one of them")
        selected = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        if mask is not None:
            selected = checks.check_tensor("mask", mask, self.device, (torch.bool,))
            fits = tuple(mask.shape) == (self.num_envs,)
            require(fits, "mask", f"expected ({self.num_envs},)", tuple(mask.shape), "give one bool per environment")
        elif env_ids is not None:
            env_ids = checks.check_env_ids(env_ids, self.num_envs, self.device, False)
            selected.index_fill_(0, env_ids, True)
        else:
            selected.fill_(True)
        with torch.no_grad():
            self._restart(selected)

    def _restart(self, mask: Bool[Tensor, "B"]) -> None:
        """Draw for all environments, store for those in `mask`, so that no draw depends on which others reset."""
        kind = (self.uniform(self.num_envs, 1) >= self.share_limits).sum(-1)
        low, high = self.low[kind], self.high[kind]
        u = self.uniform(*self.values.shape)
        drawn = low + (high - low) * u
        for name in self.integer_fields:
            n = self.names.index(name)
            drawn[:, n] = (low[:, n] + (high[:, n] - low[:, n] + 1) * u[:, n]).floor().minimum(high[:, n])
        self.values.copy_(torch.where(mask[:, None], drawn, self.values))

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the state of the random number generator."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Set the state of the random number generator."""
        self.generator.set_state(state["generator"].cpu())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> DomainRandomization:
        old_device = self.device
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if self.device != old_device:
            self.generator = torch.Generator(self.device).manual_seed(self.seed)
        return self
