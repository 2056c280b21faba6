"""The learned head's weights: their shapes, and the file that holds them, checked before use."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import message, require
from torchelev.files.output_files import atomic_file
from torchelev.traversability.features import NUM_FEATURES
from torchelev.traversability.trained_range import RANGES

if TYPE_CHECKING:
    from jaxtyping import Float

VERSION = 2  # of the file format
_CONFIG_KEYS = {"cell_channels", "stance_channels", "ranges"}
_RULE, _HINT = "must be a file of weights", "write it with TraversabilityNet.save"


class Weights(NamedTuple):
    """The head's parameters, layer by layer (see `rate`).

    F features, C channels of a cell, D of a cell and the minima in a foot's reach, S of a stance, N ratios of a robot.
    """

    cell: Float[Tensor, "C F"]  #: first layer: the features of a cell
    cell_bias: Float[Tensor, "C"]  #: first layer
    cell_condition: Float[Tensor, "C N"]  #: first layer: the robot's ratios, added to the bias
    foot: Float[Tensor, "S D"]  #: second layer: the cell under each foot
    center: Float[Tensor, "S D"]  #: second layer: the cell under the body's centre
    attitude: Float[Tensor, "S 3"]  #: second layer: the body's slope, step and belly
    stance_bias: Float[Tensor, "S"]  #: second layer
    stance_condition: Float[Tensor, "S N"]  #: second layer: the robot's ratios, added to the bias
    mixed: Float[Tensor, "C S+2"]  #: third layer: means over the headings of S channels, `stands` and `complete`
    mixed_bias: Float[Tensor, "C"]  #: third layer
    answer: Float[Tensor, "2 C"]  #: output: logits of traversability and confidence
    answer_bias: Float[Tensor, "2"]  #: output

    def detached(self) -> Weights:
        """Return the weights without gradients."""
        return Weights(*(value.detach() for value in self))


def weight_shapes(cell_channels: int, stance_channels: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each weight."""
    C, S, N = cell_channels, stance_channels, len(RANGES)
    D = C + (C + 1) // 2
    return dict(
        cell=(C, NUM_FEATURES),
        cell_bias=(C,),
        cell_condition=(C, N),
        foot=(S, D),
        center=(S, D),
        attitude=(S, 3),
        stance_bias=(S,),
        stance_condition=(S, N),
        mixed=(C, S + 2),
        mixed_bias=(C,),
        answer=(2, C),
        answer_bias=(2,),
    )


def write_weights(path: str | Path, config: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Write a head's config and weights to a file. Raises WriteError if it cannot be written."""
    content = io.BytesIO()  # written to a file by torch itself, a full disk would raise RuntimeError
    torch.save({"version": VERSION, "config": dict(config), "state_dict": dict(state)}, content)
    with atomic_file(path) as file:
        file.write(content.getbuffer())


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the config and the weights of a head from a file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, holds anything else or weights of another version, or some are not finite.
    """
    where, train = str(path), "train weights: python -m training.traversability"
    require(path.exists(), where, _RULE, "no file", train, FileNotFoundError)
    require(not path.is_dir(), where, _RULE, "a folder", _HINT)
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the type depends on which byte is damaged
        refused = f"a file that torch.load refuses ({type(error).__name__})"
        raise ValueError(message(where, _RULE, refused, _HINT)) from error
    actual = found.get("version") if isinstance(found, dict) else None
    require(isinstance(actual, int), where, _RULE, "a file of something else", _HINT)
    require(actual == VERSION, where, f"must be of version {VERSION}", actual, "train with this torchelev")
    config, state = found.get("config"), found.get("state_dict")
    fits = isinstance(config, dict) and isinstance(state, dict) and _is_config(config)
    fits = fits and all(isinstance(value, Tensor) for value in state.values())
    require(fits, where, _RULE, "those of another network", _HINT)
    _check_weights(where, weight_shapes(config["cell_channels"], config["stance_channels"]), state)
    return config, state


def _is_config(config: dict[str, Any]) -> bool:
    """Return whether a config has all its parts, of the right types."""
    if config.keys() != _CONFIG_KEYS:
        return False
    ranges = config["ranges"]
    has_sizes = all(type(config[name]) is int and config[name] > 0 for name in ("cell_channels", "stance_channels"))
    has_ranges = isinstance(ranges, dict) and ranges.keys() == RANGES.keys()
    return has_sizes and has_ranges and all(len(pair) == 2 for pair in ranges.values())


def _check_weights(where: str, shapes: dict[str, tuple[int, ...]], state: Mapping[str, Tensor]) -> None:
    """Refuse weights of other names or shapes than expected, and weights that are not finite."""
    found = {name: tuple(value.shape) for name, value in state.items()}
    wrong = [name for name in shapes | found if shapes.get(name) != found.get(name)]
    text = ", ".join(f"{name} {found.get(name)} instead of {shapes.get(name)}" for name in wrong)
    require(not wrong, where, "must hold weights of the shapes that its config says", text, "train them again")
    bad = ", ".join(name for name, value in state.items() if not bool(torch.isfinite(value).all()))
    require(not bad, where, "must be finite", f"NaN or inf in {bad}", "train them again")
