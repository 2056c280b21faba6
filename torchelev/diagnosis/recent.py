"""A few recent inputs of `update`, thinned, for `ElevationMap.diagnose`."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import torch
from torch import Tensor

KEPT = 8  # inputs
STRIDE = 4  # after the first KEPT updates every fourth is kept, so that a robot moves between the first and the last
ENVS = 4  # the first environments: a wrong convention is wrong in all of them
POINTS = 3000  # of each sensor, evenly spaced


class Look(NamedTuple):
    """One update's inputs, thinned."""

    number: int  #: of the update
    points: Tensor  #: (E, S, n, 3) [m] sensor frame
    T_map_sensor: Tensor  #: (E, S, 4, 4)
    T_map_base: Tensor | None  #: (E, 4, 4)
    dt: Tensor  #: (E,) [s]
    variance: Tensor | None  #: (E, S, n) [m^2]


class Recent:
    """The last few looks. They are copies: a caller may write into its own tensors, and memory stays bounded.

    Nothing is read back from the device before somebody asks. Updates within a `torch.compile` of the caller's own
    leave no trace here.
    """

    def __init__(self) -> None:
        self.looks: deque[Look] = deque(maxlen=KEPT)
        self.updates = 0
        self.since: Tensor | None = None  # (ENVS,) number of the first look that counts; None: all do

    def forget(self, env_ids: Tensor | None = None, mask: Tensor | None = None) -> None:
        """Drop what was seen in all or some environments: after a reset, poses may lie in another map frame."""
        if (env_ids is None and mask is None) or torch.compiler.is_compiling():
            self.looks.clear()
            self.updates, self.since = 0, None
            return
        with torch.inference_mode(False), torch.no_grad():
            if env_ids is not None:
                mask = (env_ids[:, None] == torch.arange(ENVS, device=env_ids.device)).any(0)
            assert mask is not None
            since = torch.zeros(ENVS, dtype=torch.int64, device=mask.device) if self.since is None else self.since
            reset = torch.nn.functional.pad(mask[:ENVS], (0, max(0, ENVS - len(mask))))
            self.since = since.masked_fill(reset, self.updates)

    def looks_at(self, env: int) -> list[Look]:
        """Return the looks since an environment's last reset; reads back from the device."""
        first = 0 if self.since is None else int(self.since[env])
        return [look for look in self.looks if look.number >= first]

    def add(
        self, points: Tensor, T_map_sensor: Tensor, T_map_base: Tensor | None, dt: Tensor, variance: Tensor | None
    ) -> None:
        """Take a look at an update's checked inputs, points (B, S, N, 3)."""
        if torch.compiler.is_compiling():
            return
        if self.updates < KEPT or self.updates % STRIDE == 0:
            step = max(1, -(-points.shape[2] // POINTS))
            with torch.inference_mode(False), torch.no_grad():  # normal tensors, which deepcopy takes
                values = [points[:ENVS, :, ::step], T_map_sensor[:ENVS], dt[:ENVS]]
                cloud, sensor, seconds = (value.detach().clone() for value in values)
                base = None if T_map_base is None else T_map_base[:ENVS].detach().clone()
                own = None if variance is None else variance[:ENVS, :, ::step].detach().clone()
            self.looks.append(Look(self.updates, cloud, sensor, base, seconds, own))
        self.updates += 1
