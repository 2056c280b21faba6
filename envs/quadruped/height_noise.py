"""The noise of height scans with which Miki et al. 2022 (Science Robotics) trained on true ground."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_SHARES = (0.6, 0.3, 0.1)  # of nominal, offset and noisy episodes
#: by kind of episode, [m]: sigma of a point in x and y, in z; of a whole scan in x and y, in z; of outliers
_SIGMAS = (
    (0.004, 0.005, 0.01, 0.04, 0.03),
    (0.004, 0.005, 0.01, 0.1, 0.1),
    (0.004, 0.1, 0.1, 0.3, 0.3),
)
_OUTLIERS = (0.02, 0.02, 0.05)  # probability by kind of episode


class HeightNoise(nn.Module):
    """Disturb height scans: each point, each scan as a whole, and outliers.

    The offset of a scan as a whole is drawn once for each episode, that of a point at each reading. The values come
    from a re-implementation and are not checked against the paper.

    Args:
        num_envs: B.
        num_scans: Scans of a robot, each with an offset of its own.
        device: Where the offsets are stored.
    """

    kind: Tensor
    offset: Tensor

    def __init__(self, num_envs: int, num_scans: int, device: torch.device | str) -> None:
        super().__init__()
        self.generator = torch.Generator(device)
        self.register_buffer("kind", torch.zeros(num_envs, dtype=torch.int64, device=device))
        self.register_buffer("offset", torch.zeros(num_envs, num_scans, 3, device=device))
        self.register_buffer("sigmas", torch.tensor(_SIGMAS, device=device), persistent=False)
        self.register_buffer("outliers", torch.tensor(_OUTLIERS, device=device), persistent=False)

    def reset(self, mask: Tensor) -> None:
        """Draw the kind of episode and the offsets in the environments of `mask` (B,) bool."""
        u = torch.rand(len(mask), generator=self.generator, device=mask.device)
        kind = (u >= _SHARES[0]).long() + (u >= _SHARES[0] + _SHARES[1]).long()
        self.kind.copy_(torch.where(mask, kind, self.kind))
        sigma = self.sigmas[self.kind][:, None, [2, 2, 3]]  # type: ignore[index]
        self.offset.copy_(torch.where(mask[:, None, None], sigma * self._normal(*self.offset.shape), self.offset))

    def shift(self, xy: Tensor, scan: int) -> Tensor:
        """Return disturbed places (B, P, 2) [m] of the points of a scan."""
        sigma = self.sigmas[self.kind][:, None, :1]  # type: ignore[index]
        return xy + self.offset[:, scan, None, :2] + sigma * self._normal(*xy.shape)

    def disturb(self, heights: Tensor, scan: int) -> Tensor:
        """Return disturbed heights (B, P) [m] of the points of a scan."""
        sigma = self.sigmas[self.kind]  # type: ignore[index]
        u = torch.rand(heights.shape, generator=self.generator, device=heights.device)
        far = (u < self.outliers[self.kind][:, None]) * sigma[:, 4:5]  # type: ignore[index]
        noise = torch.hypot(sigma[:, 1:2], far) * self._normal(*heights.shape)
        return heights + self.offset[:, scan, 2:] + noise

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the state of the random number generator."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Set the state of the random number generator."""
        self.generator.set_state(state["generator"].cpu())

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.offset.device)
