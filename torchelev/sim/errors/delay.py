"""Clouds that arrive late, together with the poses at which they were taken."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from torchelev.errors import require

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Cloud(NamedTuple):
    """One cloud per environment, and the sensor poses that come with it."""

    points: Float[Tensor, "B M 3"]  #: [m] sensor frame, NaN where there is no return
    T_map_sensor: Float[Tensor, "B 4 4"] | None  #: poses for the map update; None if none were given


class Delay(nn.Module):
    """Ring buffer of the latest clouds and poses, from which each environment reads with its own latency.

    The first cloud determines the size of the buffer.

    Args:
        max_latency: Largest latency that can be read [calls].
        num_envs: B.
        device: Where the buffer is stored.
    """

    slot: Tensor
    age: Tensor
    clouds: Tensor | None
    poses: Tensor | None

    def __init__(self, max_latency: int, num_envs: int, device: torch.device | str = "cpu") -> None:
        super().__init__()
        self.max_latency = max_latency
        self.register_buffer("slot", torch.zeros(1, dtype=torch.int64, device=device), persistent=False)
        self.register_buffer("age", torch.zeros(num_envs, dtype=torch.int64, device=device), persistent=False)
        self.register_buffer("clouds", None, persistent=False)
        self.register_buffer("poses", None, persistent=False)

    def reset(self, mask: Bool[Tensor, "B"]) -> None:
        """Forget the clouds of the environments in `mask`."""
        self.age.masked_fill_(mask, 0)

    def forward(
        self, points: Float[Tensor, "B M 3"], T_map_sensor: Float[Tensor, "B 4 4"], latency: Int[Tensor, "B"]
    ) -> Cloud:
        """Store the current clouds and return those of `latency` calls ago, or NaN if that was before the reset.

        Raises:
            ValueError: The shape or dtype differs from that of the first cloud.
        """
        clouds, poses = self._require_buffers(points, T_map_sensor)
        with torch.no_grad():
            clouds.index_copy_(0, self.slot, points[None])
            poses.index_copy_(0, self.slot, T_map_sensor[None])
            slot = (self.slot - latency) % (self.max_latency + 1)
            is_stored = self.age >= latency
            self.slot.add_(1).remainder_(self.max_latency + 1)
            self.age.add_(1)
        env = torch.arange(len(slot), device=slot.device)
        delayed = clouds[slot, env].masked_fill_(~is_stored[:, None, None], float("nan"))
        return Cloud(delayed, torch.where(is_stored[:, None, None], poses[slot, env], T_map_sensor))

    def get_extra_state(self) -> dict[str, Tensor | None]:
        """Return the buffer for `state_dict`, as its size is known only after the first cloud."""
        return {"slot": self.slot, "age": self.age, "clouds": self.clouds, "poses": self.poses}

    def set_extra_state(self, state: dict[str, Tensor | None]) -> None:
        """Restore a copy of the buffer of a `state_dict`."""
        for name, value in state.items():
            setattr(self, name, None if value is None else value.to(self.slot.device, copy=True))

    def _require_buffers(self, points: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Return the buffers, which the first call allocates, and refuse input that does not fit into them."""
        if self.clouds is None or self.poses is None:
            with torch.inference_mode(False):  # inference tensors could not be written outside of inference mode
                self.clouds = points.new_zeros((self.max_latency + 1, *points.shape))
                self.poses = poses.new_zeros((self.max_latency + 1, *poses.shape))
        actual = f"{tuple(points.shape)} {points.dtype}, {poses.dtype}"
        fits = self.clouds.shape[1:] == points.shape and self.clouds.dtype == points.dtype
        fits = fits and self.poses.dtype == poses.dtype
        rule = f"must stay {tuple(self.clouds.shape[1:])} {self.clouds.dtype}, {self.poses.dtype}"
        require(fits, "points, T_map_sensor", rule, actual, "make one SensorErrors for each sensor")
        return self.clouds, self.poses
