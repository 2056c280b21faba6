"""Helpers of all networks: files of weights, checked before use, and resolutions of maps."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from torchelev.errors import message, require
from torchelev.files.output_files import atomic_file

Net = TypeVar("Net", bound=nn.Module)
RESOLUTIONS = (0.02, 0.1)  # [m] limits of the maps that networks are trained for
_TOLERANCE = 1e-6  # relative, of limits


def write_weights(path: str | Path, version: int, config: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Write a network's config and weights to a file. Raises WriteError if it cannot be written."""
    content = io.BytesIO()  # written to a file by torch itself, a full disk would raise RuntimeError
    torch.save({"version": version, "config": dict(config), "state_dict": dict(state)}, content)
    with atomic_file(path) as file:
        file.write(content.getbuffer())


class WeightFormat(NamedTuple):
    """The files of one network."""

    version: int  #: of the format
    is_config: Callable[[dict[str, Any]], bool]  #: returns whether a dict is a config of the network
    save: str  #: the method that writes such files, for hints
    train: str  #: the command that trains the weights, for hints

    def build(self, path: Path, make: Callable[..., Net]) -> Net:
        """Return the network in a file; `make` makes one of its config.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is damaged, holds anything else or weights of another version, or some are not
                finite.
        """
        config, state = self._read(path)
        net = make(**config)
        _require_same_shapes(path, net.state_dict(), state)
        net.load_state_dict(state)
        return net

    def _read(self, path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
        hint, where, train = f"write it with {self.save}", str(path), f"train weights: {self.train}"
        require(path.exists(), where, "must be a file of weights", "no file", train, FileNotFoundError)
        require(not path.is_dir(), where, "must be a file of weights", "a folder", hint)
        try:
            found = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # the type depends on which byte is damaged
            refused = f"a file that torch.load refuses ({type(error).__name__})"
            raise ValueError(message(where, "must be a file of weights", refused, hint)) from error
        actual = found.get("version") if isinstance(found, dict) else None
        require(isinstance(actual, int), where, "must be a file of weights", "a file of something else", hint)
        rule = f"must be of version {self.version}"
        require(actual == self.version, where, rule, actual, "train with this torchelev")
        config, state = found.get("config"), found.get("state_dict")
        fits = isinstance(config, dict) and isinstance(state, dict) and self.is_config(config)
        fits = fits and all(isinstance(value, Tensor) for value in state.values())
        require(fits, where, "must be a file of weights", "those of another network", hint)
        return config, state


def _require_same_shapes(path: Path, expected: Mapping[str, Tensor], actual: Mapping[str, Tensor]) -> None:
    """Refuse weights of other names or shapes than expected, and weights that are not finite."""
    shapes, found = ({name: tuple(value.shape) for name, value in each.items()} for each in (expected, actual))
    wrong = [name for name in shapes | found if shapes.get(name) != found.get(name)]
    text = ", ".join(f"{name} {found.get(name)} instead of {shapes.get(name)}" for name in wrong)
    require(not wrong, str(path), "must hold weights of the shapes that its config says", text, "train them again")
    bad = ", ".join(name for name, value in actual.items() if not bool(torch.isfinite(value).all()))
    require(not bad, str(path), "must be finite", f"NaN or inf in {bad}", "train them again")


# What networks are trained for -----------------------------------------------------------------------------------


def is_within(value: float, limits: tuple[float, float]) -> bool:
    """Return whether a value lies within limits, up to rounding."""
    low, high = limits
    return low * (1 - _TOLERANCE) <= value <= high * (1 + _TOLERANCE)


def require_resolution(
    resolution: float, name: str = "resolution", use: str = "", hint: str = "resample the map"
) -> None:
    """Refuse a resolution outside RESOLUTIONS; name, use and hint are for the error."""
    low, high = RESOLUTIONS
    require(is_within(resolution, RESOLUTIONS), name, f"must be {low:g} to {high:g} m{use}", resolution, hint)
