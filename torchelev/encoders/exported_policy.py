"""An attention model as TorchScript and ONNX take it: without TensorDicts and distributions."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn


class _DeterministicPolicy(nn.Module):
    """A copy of an `AttentionModel` that returns its deterministic outputs."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.obs_normalizer = copy.deepcopy(model.obs_normalizer)
        self.encoders = nn.ModuleList(copy.deepcopy(encoder) for encoder in model.encoders.values())
        self.num_inputs = [len(groups) for groups in model.map_groups.values()]
        self.mlp = copy.deepcopy(model.mlp)
        has_distribution = model.distribution is not None
        self.deterministic_output = (
            model.distribution.as_deterministic_output_module() if has_distribution else nn.Identity()
        )

    def act(self, obs: Tensor, maps: list[Tensor]) -> Tensor:
        """Return the outputs (B, A) for the proprioception (B, D) and the groups of the maps."""
        state = self.obs_normalizer(obs)
        latents = [state]
        first = 0
        for index, encoder in enumerate(self.encoders):
            last = first + self.num_inputs[index]
            latents.append(encoder(state, maps[first:last]))
            first = last
        return self.deterministic_output(self.mlp(torch.cat(latents, -1)))


class TorchAttentionModel(_DeterministicPolicy):
    """An attention model for `torch.jit.script`."""

    def forward(self, obs: Tensor, maps: list[Tensor]) -> Tensor:
        """Return the outputs (B, A).

        Args:
            obs: proprioception (B, D), its groups concatenated.
            maps: the groups of `AttentionModel.map_inputs`, in this order.
        """
        return self.act(obs, maps)

    @torch.jit.export
    def reset(self) -> None:
        """Do nothing: the model is not recurrent."""


class OnnxAttentionModel(_DeterministicPolicy):
    """An attention model for `torch.onnx.export`."""

    is_recurrent: bool = False

    def __init__(self, model: Any, verbose: bool = False) -> None:
        super().__init__(model)
        self.verbose, self.obs_dim = verbose, model.obs_dim
        self.map_inputs, self.map_shapes = model.map_inputs, model.map_shapes

    def forward(self, obs: Tensor, *maps: Tensor) -> Tensor:
        """Return the outputs (B, A) for the proprioception (B, D) and the groups of the maps."""
        return self.act(obs, list(maps))

    def get_dummy_inputs(self) -> tuple[Tensor, ...]:
        """Return inputs of one environment, for tracing."""
        return (torch.zeros(1, self.obs_dim), *(torch.zeros(1, *shape) for shape in self.map_shapes))

    @property
    def input_names(self) -> list[str]:
        """The names of the ONNX inputs."""
        return ["obs", *self.map_inputs]

    @property
    def output_names(self) -> list[str]:
        """The names of the ONNX outputs."""
        return ["actions"]
