"""What differs between environments: values that each draws for itself at reset, from ranges or kinds of episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchelev import checks
from torchelev.errors import require, require_count

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

Range = float | tuple[float, float]  # one value for all, or (low, high): each environment draws its own, uniformly


def limits(value: Range) -> tuple[float, float]:
    """Return the lowest and the highest value."""
    low, high = value if isinstance(value, tuple) else (value, value)
    return float(low), float(high)


def check_range(name: str, value: Any, lowest: float = 0.0, highest: float = math.inf) -> None:
    """Refuse what is neither a number nor a pair (low, high) of numbers from `lowest` to `highest`."""
    pair = value if isinstance(value, tuple) else (value, value)
    numbers = len(pair) == 2 and all(isinstance(v, int | float) and math.isfinite(v) for v in pair)
    require(numbers, name, "must be a finite number or two", repr(value), "give one value or a pair (low, high)")
    within = lowest <= pair[0] <= pair[1] <= highest
    rule = f"must have {lowest:g} <= low <= high <= {highest:g}"
    require(within, name, rule, repr(value), "give one value or a pair (low, high) within")


class DomainRandomization(nn.Module):
    """B environments, each with its own values of a config's fields, drawn at reset and constant until the next.

    Args:
        cfg: one config, or kinds of episodes as pairs (share, config): an environment draws its kind by the shares,
            then each value, evenly from that kind's range.
        num_envs: B.
        device: where the values are and the errors are drawn; `.to()` moves them and seeds anew.
        seed: the same seed and the same calls give the same values to the bit on the same kind of device.

    Raises ValueError or TypeError for other configs and for shares that do not sum to 1.
    """

    config: type  # of `cfg`
    whole: tuple[str, ...] = ()  # fields whose values are whole numbers, both ends included
    low: Tensor
    high: Tensor
    until: Tensor
    values: Tensor

    def __init__(self, cfg: Any, num_envs: int, device: torch.device | str = "cpu", seed: int = 0) -> None:
        super().__init__()
        kinds: Sequence[tuple[float, Any]] = cfg if isinstance(cfg, list | tuple) else ((1.0, cfg),)
        config = all(isinstance(kind, tuple) and len(kind) == 2 and isinstance(kind[1], self.config) for kind in kinds)
        name = self.config.__name__
        require(config, "cfg", f"must be a {name} or pairs (share, {name})", repr(cfg), f"make a {name}", TypeError)
        shares = [float(share) for share, _ in kinds]
        fits = min(shares, default=-1.0) >= 0 and abs(sum(shares) - 1) < 1e-6
        require(fits, "cfg", "must have shares that sum to 1", shares, "give pairs (share, config)")
        self.num_envs = require_count("num_envs", num_envs, "give the number of environments")
        self.cfg, self.seed = cfg, seed
        self.names = [field.name for field in fields(kinds[0][1])]
        ranges = torch.tensor([[limits(getattr(kind, name)) for name in self.names] for _, kind in kinds])
        self._in_use = {name for name, r in zip(self.names, ranges.unbind(1), strict=True) if bool((r != 0).any())}
        self._highest = dict(zip(self.names, ranges[..., 1].amax(0).tolist(), strict=True))
        self.register_buffer("low", ranges[..., 0].to(device), persistent=False)
        self.register_buffer("high", ranges[..., 1].to(device), persistent=False)
        self.register_buffer("until", torch.tensor(shares).cumsum(0)[:-1].to(device), persistent=False)
        self.register_buffer("values", torch.zeros(num_envs, len(self.names), device=device))
        self.generator = torch.Generator(device).manual_seed(seed)

    @property
    def device(self) -> torch.device:
        """The device that holds the values."""
        return self.values.device

    def value(self, name: str, dims: int = 1) -> Tensor:
        """Return each environment's value of a field, (B,) or, for `dims` dimensions, (B, 1, ...)."""
        return self.values[:, self.names.index(name)].view(-1, *[1] * (dims - 1))

    def columns(self, *names: str) -> Tensor:
        """Return each environment's values of some fields (B, len(names))."""
        return torch.stack([self.value(name) for name in names], -1)

    def uses(self, *names: str) -> bool:
        """Tell whether one of the fields can differ from 0 in some environment."""
        return not self._in_use.isdisjoint(names)

    def highest(self, name: str) -> int:
        """Return the highest whole value of a field that an environment can draw."""
        return round(self._highest[name])

    def uniform(self, *shape: int) -> Tensor:
        """Draw numbers evenly from 0 to 1."""
        return torch.rand(shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        """Draw numbers of mean 0 and variance 1."""
        return torch.randn(shape, generator=self.generator, device=self.device)

    def reset(self, env_ids: Int[Tensor, "K"] | None = None, *, mask: Bool[Tensor, "B"] | None = None) -> None:
        """Draw new values in some environments: all, those of `env_ids`, or those of `mask` (no host sync)."""
        require(env_ids is None or mask is None, "env_ids, mask", "exclude each other", "both", "give one of them")
        chosen = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        if mask is not None:
            chosen = checks.check_tensor("mask", mask, self.device, (torch.bool,))
            fits = tuple(mask.shape) == (self.num_envs,)
            require(fits, "mask", f"expected ({self.num_envs},)", tuple(mask.shape), "give one bool per environment")
        elif env_ids is not None:
            env_ids = checks.check_env_ids(env_ids, self.num_envs, self.device, False)
            chosen.index_fill_(0, env_ids, True)
        else:
            chosen.fill_(True)
        with torch.no_grad():
            self._restart(chosen)

    def _restart(self, mask: Bool[Tensor, "B"]) -> None:
        """Draw for all, keep for those of `mask`: the draws of one environment do not depend on who else resets."""
        kind = (self.uniform(self.num_envs, 1) >= self.until).sum(-1)
        low, high = self.low[kind], self.high[kind]
        u = self.uniform(*self.values.shape)
        drawn = low + (high - low) * u
        for name in self.whole:
            n = self.names.index(name)
            drawn[:, n] = (low[:, n] + (high[:, n] - low[:, n] + 1) * u[:, n]).floor().minimum(high[:, n])
        self.values.copy_(torch.where(mask[:, None], drawn, self.values))

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the state of the random numbers."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Set the state of the random numbers."""
        self.generator.set_state(state["generator"].cpu())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> DomainRandomization:
        before = self.device
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if self.device != before:
            self.generator = torch.Generator(self.device).manual_seed(self.seed)
        return self
