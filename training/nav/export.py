"""Export a trained policy to TorchScript and ONNX, and check that both return its actions."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from envs.terrain_nav import TerrainNav, TerrainNavConfig
from envs.terrain_nav.proprioception import ENTRIES
from envs.terrain_nav.sight import MapSight
from torchelev.errors import require
from training import episode
from training.runner import ResumableRunner, export_onnx

_TOLERANCE = 1e-4  # largest difference of an action


def export(runner: ResumableRunner, folder: Path, tolerance: float = _TOLERANCE) -> None:
    """Write policy.pt and policy.onnx to a folder.

    Raises:
        ValueError: an exported policy returns other actions than the trained one.
    """
    logging.getLogger("torch.onnx").setLevel(
        logging.ERROR
    )  # it warns about operators of packages that are not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporters warn about their own deprecations
        runner.export_policy_to_jit(str(folder), "policy.pt")
        export_onnx(runner, folder / "policy.onnx")
    actor = runner.get_inference_policy(device="cpu")
    observation = runner.env.get_observations().to("cpu")
    with torch.inference_mode():
        expected = actor(observation).numpy()
        scripted = torch.jit.load(str(folder / "policy.pt"))(observation["policy"], [observation["map"]]).numpy()
    for name, actual in (("policy.pt", scripted), ("policy.onnx", run_onnx(folder / "policy.onnx", observation))):
        error = float(np.abs(actual - expected[: len(actual)]).max())
        require(error < tolerance, name, "must act as the policy does", f"an error of {error:.2g}", "report it")
    actor.to(runner.device)


def record(policy: Any, cfg: TerrainNavConfig, folder: Path) -> bool:
    """Write an episode with the map in the loop beside policy.onnx.

    Returns:
        False, with nothing written, if the policy reads images that are filled or show ceilings, as no `MapImage` does,
        or if structures stand on the course, whose map has levels.
    """
    task = TerrainNav(cfg, 1, "cpu", "map", seed=12)
    sight = task.sight
    assert isinstance(sight, MapSight)
    if sight.filled_scan is not None or sight.read_ceilings is not None or task.course.structures is not None:
        return False
    groups: dict[str, Any] = {"policy": ENTRIES, "map": sight.crop}
    episode.record(task, sight.emap, groups, policy, lambda: (sight.T_estimated, None), folder)
    return True


def run_onnx(path: Path, observation: Any) -> np.ndarray:
    """Return the actions (8, 2) of an ONNX policy for the first eight observations."""
    from onnx.reference import ReferenceEvaluator

    session = ReferenceEvaluator(str(path))
    actions = []
    for policy, crop in zip(observation["policy"][:8], observation["map"][:8], strict=True):
        inputs = dict(zip(session.input_names, (policy[None].numpy(), crop[None].numpy()), strict=True))
        outputs = session.run(None, inputs)
        assert isinstance(outputs, list)
        actions.append(outputs[0])
    return np.concatenate(actions)
