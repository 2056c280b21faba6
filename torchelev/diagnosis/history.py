"""Thinned copies of a few recent inputs, for `ElevationMap.diagnose`."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.inputs.update_inputs import Inputs
from torchelev.ops.transforms import is_readable

MAX_ENVS = 4  # the first environments: a wrong convention is wrong in all of them
MAX_UPDATES = 8
MAX_CORRECTIONS = 32  # of updates in a row
MAX_POINTS = 3000  # per sensor, evenly spaced
# After the first updates two of seven are kept, so that a robot moves between the first and the last, and sensors that
# take turns, two to six of them, are all among them.
PERIOD = 7


class PastUpdate(NamedTuple):
    """One update's inputs: the first environments, and some of their points."""

    number: int  #: of the update, counted from 0
    inputs: Inputs  #: copies


class InputHistory:
    """The inputs of the last few updates.

    They are copies: callers may overwrite their tensors, and memory stays bounded. Nothing waits for the device before
    `updates_of` reads. Updates inside a `torch.compile` of the caller's own are not kept.
    """

    def __init__(self) -> None:
        self._updates: deque[PastUpdate] = deque(maxlen=MAX_UPDATES)
        self._num_updates = 0
        self._corrections: deque[tuple[int, Tensor | list[float]]] = deque(maxlen=MAX_CORRECTIONS)
        self._first: Tensor | None = None  # (MAX_ENVS,) number of the first update since the last reset; None: 0

    def add(self, inputs: Inputs, last_correction: Tensor) -> None:
        """Keep an update's inputs, if it is their turn, and the drift correction (B,) [m] of the update before it."""
        if torch.compiler.is_compiling():
            return
        few = last_correction[:MAX_ENVS]
        if is_readable(few):
            self._corrections.append((self._num_updates - 1, few.tolist()))
        else:
            with torch.inference_mode(False), torch.no_grad():
                self._corrections.append((self._num_updates - 1, few.detach().clone()))
        if self._num_updates < MAX_UPDATES or self._num_updates % PERIOD < 2:
            self._updates.append(PastUpdate(self._num_updates, _thin(inputs)))
        self._num_updates += 1

    def forget(self, env_ids: Tensor | None = None, mask: Tensor | None = None) -> None:
        """Forget the inputs of all environments, or of some: after a reset, poses may be in another map frame."""
        if (env_ids is None and mask is None) or torch.compiler.is_compiling():
            self._updates.clear()
            self._corrections.clear()
            self._num_updates, self._first = 0, None
            return
        with torch.inference_mode(False), torch.no_grad():
            if env_ids is not None:
                mask = (env_ids[:, None] == torch.arange(MAX_ENVS, device=env_ids.device)).any(0)
            assert mask is not None
            first = torch.zeros(MAX_ENVS, dtype=torch.int64, device=mask.device) if self._first is None else self._first
            is_reset = torch.nn.functional.pad(mask[:MAX_ENVS], (0, max(0, MAX_ENVS - len(mask))))
            self._first = first.masked_fill(is_reset, self._num_updates)

    def updates_of(self, env: int) -> list[PastUpdate]:
        """Return the updates since an environment's last reset. Waits for the device."""
        first = 0 if self._first is None else int(self._first[env])
        return [update for update in self._updates if update.number >= first]

    def corrections_of(self, env: int) -> list[float]:
        """Return the drift corrections [m] of the last updates but one since an environment's reset, in their order."""
        first = 0 if self._first is None else int(self._first[env])
        return [float(correction[env]) for number, correction in self._corrections if number >= first]


def _thin(inputs: Inputs) -> Inputs:
    """Copy the inputs of the first environments, with every k-th point."""
    step = max(1, -(-inputs.points.shape[2] // MAX_POINTS)) | 1  # odd: rings and columns often are powers of two

    def copy(value: Tensor) -> Tensor:
        return value[:MAX_ENVS].detach().clone()

    with torch.inference_mode(False), torch.no_grad():  # normal tensors, which can be deep-copied
        return Inputs(
            points=copy(inputs.points[:, :, ::step]),
            T_map_sensor=copy(inputs.T_map_sensor),
            T_map_base=None if inputs.T_map_base is None else copy(inputs.T_map_base),
            dt=copy(inputs.dt),
            variance=None if inputs.variance is None else copy(inputs.variance[:, :, ::step]),
            T_base_links=None if inputs.T_base_links is None else copy(inputs.T_base_links),
            pose_covariance=None if inputs.pose_covariance is None else copy(inputs.pose_covariance),
            moving=None if inputs.moving is None else copy(inputs.moving),
        )
