"""Export a trained policy to TorchScript and ONNX, and check that both act as it does."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchelev.errors import require
from training.nav.runner import ResumableRunner

TOLERANCE = 1e-4


def export(runner: ResumableRunner, folder: Path) -> None:
    """Write policy.pt and policy.onnx. Raises ValueError if either acts otherwise on random observations."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns of each operator of packages that are missing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporters, about their own deprecations
        runner.export_policy_to_jit(str(folder), "policy.pt")
        runner.export_policy_to_onnx(str(folder), "policy.onnx")
    actor = runner.get_inference_policy(device="cpu")
    observation = runner.env.get_observations().to("cpu")
    with torch.inference_mode():
        expected = actor(observation).numpy()
        scripted = torch.jit.load(str(folder / "policy.pt"))(observation["policy"], [observation["map"]]).numpy()
    for name, got in (("policy.pt", scripted), ("policy.onnx", _run_onnx(folder / "policy.onnx", observation))):
        error = float(np.abs(got - expected[: len(got)]).max())
        require(error < TOLERANCE, name, "must act as the policy does", f"an error of {error:.2g}", "report it")
    actor.to(runner.device)


def _run_onnx(path: Path, observation: Any) -> np.ndarray:
    from onnx.reference import ReferenceEvaluator

    session = ReferenceEvaluator(str(path))
    names = session.input_names
    rows = [session.run(None, {names[0]: p[None].numpy(), names[1]: m[None].numpy()})[0]
            for p, m in zip(observation["policy"][:8], observation["map"][:8], strict=True)]  # fmt: skip
    return np.concatenate(rows)
