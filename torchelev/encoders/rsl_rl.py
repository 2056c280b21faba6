"""Give rsl-rl's policies an attention encoder of the map, by the `class_name` of a model's configuration.

In rsl-rl's configuration of an actor or critic, set `class_name` to "torchelev.encoders.rsl_rl:AttentionModel" and say
in `attention_cfg` how each observation of the map is laid out, such as `{"height_scan": {"points": "isaac_lab"}}`. The
page "MLP, CNN, attention" of the documentation has the whole configuration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchelev.encoders.attention import MapAttention
from torchelev.encoders.encoder_config import AttentionConfig
from torchelev.encoders.exported_policy import OnnxAttentionModel, TorchAttentionModel
from torchelev.encoders.layout import MapLayout
from torchelev.errors import require

try:
    from rsl_rl.models import MLPModel
    from rsl_rl.utils import resolve_nn_activation
    from tensordict import TensorDict
except ImportError as error:
    hint = "install it with pip install 'torchelev[rl]'"
    raise ImportError(f"torchelev.encoders.rsl_rl: needs rsl-rl-lib; {hint}") from error

if TYPE_CHECKING:
    from jaxtyping import Float


class AttentionModel(MLPModel):
    """A model of rsl-rl (5.4 and 5.5) whose proprioception pays attention to the points of maps.

    Each group of `attention_cfg` is a map and gets a `MapAttention`. The other groups (B, D) are the proprioception: it
    is normalised as in rsl-rl's models if `obs_normalization` is set, it is the state that the encoders' queries are
    made of, and with the encodings it is the input of the MLP. Maps are not normalised, as in rsl-rl's `CNNModel`.

    `as_jit` and `as_onnx` return modules with the inputs `obs` (B, D) and the groups of `map_inputs` in their order,
    which TorchScript takes as a list.

    Args:
        obs: observations, from which shapes are taken.
        obs_groups: observation groups of each set.
        obs_set: the set of this model, such as "actor".
        output_dim: number of outputs.
        hidden_dims: sizes of the MLP's hidden layers.
        activation: of the MLP and within the encoders.
        obs_normalization: normalise the proprioception.
        distribution_cfg: of the outputs, as in rsl-rl's models.
        attention_cfg: for each map, by its group, the fields of `AttentionConfig`.

    Raises:
        ValueError: naming the group and the setting that do not fit.
    """

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: tuple[int, ...] | list[int] = (256, 256, 256),
        activation: str = "elu",
        obs_normalization: bool = False,
        distribution_cfg: dict[str, Any] | None = None,
        attention_cfg: dict[str, dict[str, Any]] | None = None,
    ) -> None:
        shapes = {name: tuple(obs[name].shape[1:]) for name in obs_groups[obs_set]}
        configs, layouts = _read_settings(attention_cfg or {}, shapes)
        # The parent's constructor asks for the dimensions below.
        self._encoding_dim = sum(cfg.embed_dim for cfg in configs.values())
        self.map_groups = {name: layout.groups for name, layout in layouts.items()}
        super().__init__(
            obs, obs_groups, obs_set, output_dim, hidden_dims, activation, obs_normalization, distribution_cfg
        )
        encoders = {
            name: MapAttention(layouts[name], cfg, self.obs_dim, resolve_nn_activation(activation))
            for name, cfg in configs.items()
        }
        self.encoders = nn.ModuleDict(encoders)
        self.map_shapes = [shapes[name] for name in self.map_inputs]

    @property
    def map_inputs(self) -> list[str]:
        """The groups that the encoders read, in the order in which exported models take them."""
        return [name for groups in self.map_groups.values() for name in groups]

    def get_latent(
        self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None
    ) -> Float[Tensor, "B L"]:
        """Return the input of the MLP: the normalised proprioception and the encodings of the maps."""
        state = super().get_latent(obs)
        encodings = [encoder(state, self._read_map(obs, name)) for name, encoder in self.encoders.items()]
        return torch.cat([state, *encodings], -1)

    def attention(self, obs: TensorDict) -> dict[str, Float[Tensor, "B heads P"]]:
        """Return for each map how much attention each head pays to each point; the weights of a head sum to 1.

        `encoders[group].coordinates[0, :2]` are x and y (2, P) [m] of the points, for a picture of where the policy
        looks. Computed anew by each call, and by no other.
        """
        state = super().get_latent(obs)
        encoders: Any = self.encoders.items()
        return {name: encoder.attention(state, self._read_map(obs, name)) for name, encoder in encoders}

    def as_jit(self) -> nn.Module:
        """Return a module for `torch.jit.script`, called as `module(obs, [map, ...])`."""
        return TorchAttentionModel(self)

    def as_onnx(self, verbose: bool = False) -> nn.Module:
        """Return a module for `torch.onnx.export`, called as `module(obs, map, ...)`."""
        return OnnxAttentionModel(self, verbose)

    def _read_map(self, obs: TensorDict, name: str) -> list[Tensor]:
        return [obs[group] for group in self.map_groups[name]]

    def _get_obs_dim(self, obs: TensorDict, obs_groups: dict[str, list[str]], obs_set: str) -> tuple[list[str], int]:
        """Return the groups of the proprioception, and their entries in total."""
        groups = [name for name in obs_groups[obs_set] if name not in self.map_inputs]
        for name in groups:
            shape, hint = tuple(obs[name].shape), "add it to attention_cfg, with its resolution or points"
            require(len(shape) == 2, name, "must be a group (B, D), or a map of attention_cfg", shape, hint)
        hint = "add the group with the proprioception to obs_groups"
        actual = ", ".join(obs_groups[obs_set])
        require(len(groups) > 0, f"obs_groups[{obs_set!r}]", "must hold a group (B, D) beside the maps", actual, hint)
        return groups, sum(obs[name].shape[-1] for name in groups)

    def _get_latent_dim(self) -> int:
        return self.obs_dim + self._encoding_dim


def _read_settings(
    attention_cfg: dict[str, dict[str, Any]], shapes: dict[str, tuple[int, ...]]
) -> tuple[dict[str, AttentionConfig], dict[str, MapLayout]]:
    """Return the settings and the layout of each map; errors name the group."""
    hint = "give {'height_scan': {'points': 'isaac_lab'}}, by the name of your group"
    require(len(attention_cfg) > 0, "attention_cfg", "must name a map", attention_cfg, hint)
    configs, layouts = {}, {}
    for name, values in attention_cfg.items():
        names, hint = ", ".join(shapes), "correct its name, or add it to obs_groups"
        require(name in shapes, "attention_cfg", f"must name some of the groups {names}", repr(name), hint)
        try:
            configs[name] = AttentionConfig.from_dict(values)
            layouts[name] = MapLayout.find(name, configs[name], shapes)
        except ValueError as error:
            raise ValueError(f"attention_cfg[{name!r}].{error}") from None
    return configs, layouts
