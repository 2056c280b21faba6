"""An episode of a trained policy with the map in the loop, for `torchelev export`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchelev import ElevationMap
from torchelev.runtime.bundle.groups import Group
from torchelev.runtime.bundle.recording import Recorder


@torch.inference_mode()
def record(
    task: Any,
    emap: ElevationMap,
    groups: Mapping[str, Group],
    policy: Callable[[Any], Tensor],
    poses: Callable[[], tuple[Tensor, Tensor | None]],
    folder: Path,
    steps: int = 40,
) -> None:
    """Let a policy act in a task of one robot, and write the episode beside its policy.onnx.

    Args:
        task: the task, whose map is `emap`.
        emap: the map.
        groups: the policy's observation groups, see `Recorder`.
        policy: returns the actions (1, A) for an observation.
        poses: returns the pose of the base (1, 4, 4) and the feet (1, K, 3), or None, at which the map is read now.
        folder: where the files are written.
        steps: number of steps.
    """
    with Recorder(emap, groups) as recorder:
        task.sense()
        for _ in range(steps):
            observation = TensorDict(task.observe(critic=False), batch_size=[1])
            action = policy(observation)
            recorder.step(observation, action, *poses())
            task.reset(task.advance(action).done)
            task.sense()
    recorder.write(folder)
