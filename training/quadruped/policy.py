"""Policies as files: TorchScript and ONNX with the layout of the scans that they read, and loading them again."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from envs.quadruped import Quadruped, QuadrupedConfig
from envs.quadruped.proprioception import ENTRIES
from envs.quadruped.sight import MapSight, make_scans
from torchelev.errors import message, require
from torchelev.observations.scan_layout import require_layout, scan_layout
from training import episode
from training.runner import ResumableRunner, export_onnx

LAYOUT = "torchelev.json"  # name of the layout in a TorchScript file, and of its metadata in an ONNX file
GROUPS = ("policy", "height_scan", "feet")  # in the order in which the network takes them, side by side
_TOLERANCE = 1e-5  # largest difference of an action

Policy = Callable[[Any], Tensor]


@dataclass(frozen=True)
class LoadedPolicy:
    """An exported policy, which returns the actions (B, 12) for an observation."""

    network: Policy  #: takes the groups side by side (B, 293)
    perception: str | None  #: with which it was trained: "map", "truth" or "blind"; None where the file does not say

    def __call__(self, observation: Any) -> Tensor:
        """Return the actions for an observation of the task."""
        return self.network(join(observation))


def sight_of(perception: str) -> str:
    """Return the perception with which a policy is deployed: a blind one stays blind, the others see the map."""
    return "blind" if perception == "blind" else "map"


def layout_of(cfg: QuadrupedConfig, perception: str) -> dict[str, Any]:
    """Describe what a policy of this task reads: its perception, its groups in order, and the layout of each scan."""
    scan, feet = make_scans(cfg)
    scans = {"height_scan": scan_layout(scan), "feet": scan_layout(feet)}
    return {"perception": perception, "groups": list(GROUPS), **scans}


def join(observation: Any) -> Tensor:
    """Return the observation groups side by side (B, 293), as exported policies take them."""
    return torch.cat([observation[name] for name in GROUPS], -1)


def export(runner: ResumableRunner, cfg: QuadrupedConfig, folder: Path) -> None:
    """Write policy.pt (TorchScript) and policy.onnx to a folder, each with its layout and perception.

    Both take the groups side by side, "policy" (50), "height_scan" (187), "feet" (56), and return actions.

    Raises:
        ValueError: An exported policy returns other actions than the trained one.
    """
    layout = json.dumps(layout_of(cfg, runner.env.task.perception))
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns about packages that are not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporters warn about their own deprecations
        runner.export_policy_to_jit(str(folder), "policy.pt")
        export_onnx(runner, folder / "policy.onnx", **{LAYOUT: layout})
        scripted = torch.jit.load(str(folder / "policy.pt"), map_location="cpu")
        torch.jit.save(scripted, str(folder / "policy.pt"), _extra_files={LAYOUT: layout})
    observation = runner.env.get_observations().to("cpu")
    actor = runner.get_inference_policy(device="cpu")
    with torch.inference_mode():
        expected = actor(observation).numpy()
        found = {"policy.pt": load_policy(folder / "policy.pt", cfg)(observation).numpy()}
    found["policy.onnx"] = run_onnx(folder / "policy.onnx", observation)
    for name, actual in found.items():
        error = float(np.abs(actual - expected[: len(actual)]).max())
        require(error < _TOLERANCE, name, "must act as the policy does", f"an error of {error:.2g}", "report it")
    actor.to(runner.device)


def record(policy: Any, cfg: QuadrupedConfig, folder: Path) -> None:
    """Write an episode with the map in the loop beside policy.onnx."""
    task = Quadruped(cfg, 1, "cpu", "map", seed=12)
    sight = task.sight
    assert isinstance(sight, MapSight)

    def poses() -> tuple[Tensor, Tensor]:
        view = task.view()
        return view.T_estimated, view.feet_in(view.T_estimated)

    groups: dict[str, Any] = {"policy": ENTRIES, "height_scan": sight.scan, "feet": sight.foot_scan}
    episode.record(task, sight.emap, groups, policy, poses, folder)


def load_policy(path: Path, cfg: QuadrupedConfig) -> LoadedPolicy:
    """Return an exported TorchScript policy, which takes observations of this task.

    Raises:
        ValueError: The file is not TorchScript or has no layout, or the task's scans are laid out otherwise than those
            of the training.
    """
    files, hint = {LAYOUT: ""}, "give a policy.pt that python -m training.quadruped wrote"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scripted = torch.jit.load(str(path), map_location="cpu", _extra_files=files)
        except RuntimeError:
            rule = "must be a policy in TorchScript"
            raise ValueError(message(str(path), rule, "another or a damaged file", hint)) from None
    require(bool(files[LAYOUT]), str(path), "must hold the layout of its scans", "none", hint)
    layout = json.loads(files[LAYOUT])
    groups = tuple(layout["groups"])
    require(groups == GROUPS, "groups", f"must be {GROUPS}", groups, "use the version that exported the policy")
    for name, scan in zip(("height_scan", "feet"), make_scans(cfg), strict=True):
        require_layout(scan, layout[name], name)
    return LoadedPolicy(scripted, layout.get("perception"))


def run_onnx(path: Path, observation: Any, count: int = 4) -> np.ndarray:
    """Return the actions (count, 12) of an ONNX policy for the first observations."""
    from onnx.reference import ReferenceEvaluator

    session = ReferenceEvaluator(str(path))
    rows = join(observation)[:count].numpy()
    actions = []
    for row in rows:
        outputs = session.run(None, {session.input_names[0]: row[None]})
        assert isinstance(outputs, list)
        actions.append(outputs[0])
    return np.concatenate(actions)
