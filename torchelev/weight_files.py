"""Files of a network's weights: its config and its tensors, checked before anything is made of them."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchelev.errors import message, require
from torchelev.output_files import atomic_file


def write_weights(path: str | Path, version: int, config: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Write a network's config and weights to a file. Raises WriteError if it cannot be written."""
    content = io.BytesIO()  # written to a file by torch itself, a full disk would raise RuntimeError
    torch.save({"version": version, "config": dict(config), "state_dict": dict(state)}, content)
    with atomic_file(path) as file:
        file.write(content.getbuffer())


def read_weights(
    path: Path, version: int, is_config: Callable[[dict[str, Any]], bool], save: str, train: str
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the config and the weights in a file.

    Args:
        path: the file.
        version: of the file format.
        is_config: tells whether a dict is a config of the network.
        save: the method that writes such files, for hints.
        train: the command that trains the weights, for hints.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, or holds anything else or weights of another version.
    """
    hint, where = f"write it with {save}", str(path)
    require(path.exists(), where, "must be a file of weights", "no file", f"train weights: {train}", FileNotFoundError)
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the type depends on which byte is damaged
        raise ValueError(message(where, "must be a file of weights", type(error).__name__, hint)) from error
    actual = found.get("version") if isinstance(found, dict) else None
    require(isinstance(actual, int), where, "must be a file of weights", "something else", hint)
    require(actual == version, where, f"must be of version {version}", actual, "train with this torchelev")
    config, state = found.get("config"), found.get("state_dict")
    fits = isinstance(config, dict) and isinstance(state, dict) and is_config(config)
    fits = fits and all(isinstance(value, Tensor) for value in state.values())
    require(fits, where, "must be a file of weights", "other parts or types", hint)
    return config, state


def require_same_shapes(path: Path, expected: Mapping[str, Tensor], actual: Mapping[str, Tensor]) -> None:
    """Refuse weights of other names or shapes than expected, and weights that are not finite."""
    shapes, found = ({name: tuple(value.shape) for name, value in each.items()} for each in (expected, actual))
    wrong = [name for name in shapes | found if shapes.get(name) != found.get(name)]
    text = ", ".join(f"{name} {found.get(name)} instead of {shapes.get(name)}" for name in wrong)
    require(not wrong, str(path), "must hold weights of the shapes that its config says", text, "train them again")
    bad = ", ".join(name for name, value in actual.items() if not bool(torch.isfinite(value).all()))
    require(not bad, str(path), "must be finite", f"NaN or inf in {bad}", "train them again")
