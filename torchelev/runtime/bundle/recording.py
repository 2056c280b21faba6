"""An episode of one environment: what its map was updated by, what the policy read, and what it did."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.files.output_files import atomic_file
from torchelev.observations.height_scan import HeightScan
from torchelev.runtime.bundle import groups as observation_groups
from torchelev.runtime.bundle.groups import Group

VERSION = 1  # of the format
CONFIG, OBSERVATION, EPISODE, POLICY = "map.json", "observation.json", "episode.npz", "policy.onnx"
_NOT_RECORDED = ("initialize", "initialize_from", "load_state")
_INPUTS = ("points", "T_map_sensor", "T_map_base", "dt", "variance", "T_base_links", "pose_covariance")


class Recorder:
    """Records one environment of a map while a policy acts.

    ```python
    with Recorder(emap, {"policy": PROPRIOCEPTION, "height_scan": scan}) as recorder:
        for _ in range(50):
            observation = env.observe()
            action = policy(observation)
            recorder.step(observation, action, T_map_base)
            env.step(action)  # updates the map
    recorder.write("runs/mine")  # beside its policy.onnx; then: torchelev export runs/mine --out bundle
    ```

    The map is forgotten at the begin, so that the episode explains all that is in it.

    Args:
        emap: the map whose updates and resets are recorded.
        groups: the observation groups in the policy's order: the names of the entries that the robot gives itself, or
            the `HeightScan` or `MapImage` that reads the map.
        env: the environment to record.

    Raises:
        ValueError: there is no such environment, the map has channels, or a group reads them.
    """

    def __init__(self, emap: ElevationMap, groups: Mapping[str, Group], env: int = 0) -> None:
        require(0 <= env < emap.num_envs, "env", f"must be from 0 to {emap.num_envs - 1}", env, "give an environment")
        observation_groups.require_heights(groups)
        channels, hint = tuple(emap.cfg.channels), "record a map without channels"
        require(not channels, "emap.cfg.channels", "must be empty, as bundles hold heights alone", channels, hint)
        self.emap, self.groups, self.env = emap, dict(groups), env
        self._updates: list[dict[str, np.ndarray]] = []
        self._steps: list[dict[str, np.ndarray]] = []
        self._resets = True  # before the next update

    def __enter__(self) -> Recorder:
        self.emap.reset(torch.tensor([self.env], device=self.emap.device))
        for name in ("update", "reset"):  # of this object alone
            self.emap.__dict__[name] = getattr(self, f"_{name}")
        for name in _NOT_RECORDED:
            self.emap.__dict__[name] = functools.partial(_refuse, name)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for name in ("update", "reset", *_NOT_RECORDED):
            self.emap.__dict__.pop(name, None)

    def _update(self, *args: Any, **kwargs: Any) -> None:
        update: Callable[..., None] = type(self.emap).update
        update(self.emap, *args, **kwargs)
        values = dict(zip(_INPUTS, args, strict=False)) | kwargs
        row = {name: self._own(value) for name, value in values.items() if value is not None}
        row["step"], row["resets"] = np.array(len(self._steps)), np.array(self._resets)
        self._updates.append(row)
        self._resets = False

    def _reset(self, env_ids: Tensor | None = None, *, mask: Tensor | None = None) -> None:
        type(self.emap).reset(self.emap, env_ids, mask=mask)
        is_all = env_ids is None and mask is None
        chosen = mask[self.env] if mask is not None else (env_ids == self.env).any() if env_ids is not None else is_all
        self._resets = self._resets or bool(chosen)

    def _own(self, value: Any) -> np.ndarray:
        """Return the environment's part of an input, float32 or float64; of a number, that number."""
        if not isinstance(value, Tensor):
            return np.array(value, np.float64)
        value = (value if value.ndim == 0 else value[self.env]).detach().cpu()
        return (value if value.dtype in (torch.float32, torch.float64) else value.float()).numpy().copy()

    def step(
        self, observation: Mapping[str, Tensor], action: Tensor, T_map_base: Tensor, feet: Tensor | None = None
    ) -> None:
        """Record what the policy read and did.

        Args:
            observation: the groups (B, ...), by name.
            action: (B, A).
            T_map_base: the poses (B, 4, 4) at which the scans and images were read.
            feet: the feet (B, K, 3) [m] at which scans around feet were read.

        Raises:
            ValueError: a group is missing or of another shape.
        """
        row = {"T_map_base": T_map_base[self.env].double(), "action": action[self.env]}
        row["resets"] = torch.tensor(self._resets and len(self._updates) > 0)  # after the last update
        takes_feet = any(isinstance(group, HeightScan) and group.num_feet > 0 for group in self.groups.values())
        given = feet is not None or not takes_feet
        require(given, "feet", "must be given for scans around feet", "none", "give those of the observation")
        if feet is not None and takes_feet:
            row["feet"] = feet[self.env].double()
        for name, group in self.groups.items():
            actual = tuple(observation[name].shape[1:]) if name in observation.keys() else None
            shape = observation_groups.shape_of(group)
            require(actual == shape, f"observation.{name}", f"expected (B, *{shape})", actual, "name the right groups")
            row[f"group_{name}"] = observation[name][self.env]
        self._steps.append({name: value.detach().cpu().numpy().copy() for name, value in row.items()})

    def write(self, folder: str | Path) -> None:
        """Write config, groups and episode to a folder.

        Raises:
            ValueError: nothing was recorded, or the number of sensors changed.
            WriteError: a file cannot be written.
        """
        require(len(self._steps) > 0, "recorder", "must have recorded a step", "none", "call step")
        folder = Path(folder)
        arrays: dict[str, Any] = _stack("step", self._steps) | _stack("update", self._updates)
        self.emap.cfg.save(folder / CONFIG)
        described = {"torchelev_bundle": VERSION, "groups": observation_groups.to_json(self.groups)}
        with atomic_file(folder / OBSERVATION) as file:
            file.write((json.dumps(described, indent=1, allow_nan=False) + "\n").encode())
        with atomic_file(folder / EPISODE) as file:
            np.savez_compressed(file, **arrays)


def _refuse(name: str, *args: Any, **kwargs: Any) -> None:
    hint = "call it before the recording: the map is forgotten then, and updates alone explain what is in it"
    require(False, f"emap.{name}", "is not recorded", "a call", hint, NotImplementedError)


def _stack(prefix: str, rows: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return rows as arrays, one for each name; what some rows lack is marked by the array `<name>_given`."""
    arrays = {}
    for name in dict.fromkeys(key for row in rows for key in row):
        given = [name in row for row in rows]
        found = [row[name] for row in rows if name in row]
        blank = np.zeros_like(found[0])
        padded = _padded(name, [row.get(name, blank) for row in rows])
        arrays[f"{prefix}_{name}"] = np.stack(padded)
        if not all(given):
            arrays[f"{prefix}_{name}_given"] = np.array(given)
    return arrays


def _padded(name: str, values: list[np.ndarray]) -> list[np.ndarray]:
    """Return values of one shape: clouds of fewer points end with NaN."""
    axis = {"points": -2, "variance": -1}.get(name)
    if axis is None:
        sizes = sorted({value.shape for value in values})
        require(len(sizes) == 1, name, "must keep its shape while it is recorded", sizes, "record with all sensors")
        return values
    most = max(value.shape[axis] for value in values)
    pads = [[(0, 0)] * value.ndim for value in values]
    for pad, value in zip(pads, values, strict=True):
        pad[axis] = (0, most - value.shape[axis])
    return [np.pad(value, pad, constant_values=np.nan) for value, pad in zip(values, pads, strict=True)]
