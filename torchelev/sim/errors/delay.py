"""Clouds that arrive late, each with the pose it was taken at."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from torchelev.errors import require

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Cloud(NamedTuple):
    """What a sensor gives at one instant, for each environment."""

    points: Float[Tensor, "B M 3"]  #: [m] sensor frame, NaN where nothing came back
    T_map_sensor: Float[Tensor, "B 4 4"] | None  #: where they were taken, or are accepted to have been


class Delay(nn.Module):
    """A ring of the last clouds and poses of B environments: each gets back the cloud of its own number of calls ago.

    Args:
        longest: the most calls that a cloud can be late.
        num_envs: B.
        device: where the ring is; it takes its size from the first cloud.
    """

    slot: Tensor
    age: Tensor
    clouds: Tensor | None
    poses: Tensor | None

    def __init__(self, longest: int, num_envs: int, device: torch.device | str = "cpu") -> None:
        super().__init__()
        self.longest = longest
        self.register_buffer("slot", torch.zeros(1, dtype=torch.int64, device=device), persistent=False)
        self.register_buffer("age", torch.zeros(num_envs, dtype=torch.int64, device=device), persistent=False)
        self.register_buffer("clouds", None, persistent=False)
        self.register_buffer("poses", None, persistent=False)

    def reset(self, mask: Bool[Tensor, "B"]) -> None:
        """Forget the clouds of the environments of `mask`."""
        self.age.masked_fill_(mask, 0)

    def forward(
        self, points: Float[Tensor, "B M 3"], T_map_sensor: Float[Tensor, "B 4 4"], latency: Int[Tensor, "B"]
    ) -> Cloud:
        """Take in the clouds of now; return those of `latency` (B,) calls ago, or NaN where there was none yet.

        Raises ValueError for another number of points than before.
        """
        clouds, poses = self._ring(points, T_map_sensor)
        with torch.no_grad():
            clouds.index_copy_(0, self.slot, points[None])
            poses.index_copy_(0, self.slot, T_map_sensor[None])
            taken = (self.slot - latency) % (self.longest + 1)
            there = self.age >= latency
            self.slot.add_(1).remainder_(self.longest + 1)
            self.age.add_(1)
        env = torch.arange(len(taken), device=taken.device)
        late = clouds[taken, env].masked_fill(~there[:, None, None], float("nan"))
        return Cloud(late, torch.where(there[:, None, None], poses[taken, env], T_map_sensor))

    def get_extra_state(self) -> dict[str, Tensor | None]:
        """Return the ring, whose size the first cloud decides."""
        return {"slot": self.slot, "age": self.age, "clouds": self.clouds, "poses": self.poses}

    def set_extra_state(self, state: dict[str, Tensor | None]) -> None:
        """Take over a ring."""
        for name, value in state.items():
            setattr(self, name, None if value is None else value.to(self.slot.device, copy=True))

    def _ring(self, points: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
        if self.clouds is None or self.poses is None:
            with torch.inference_mode(False):  # else no later call outside of that mode could write into it
                self.clouds = points.new_zeros((self.longest + 1, *points.shape))
                self.poses = poses.new_zeros((self.longest + 1, *poses.shape))
        actual = f"{tuple(points.shape)} {points.dtype}, {poses.dtype}"
        same = self.clouds.shape[1:] == points.shape and self.clouds.dtype == points.dtype
        same = same and self.poses.dtype == poses.dtype
        rule = f"must stay {tuple(self.clouds.shape[1:])} {self.clouds.dtype}, {self.poses.dtype}"
        require(same, "points, T_map_sensor", rule, actual, "make one SensorErrors for each sensor")
        return self.clouds, self.poses
