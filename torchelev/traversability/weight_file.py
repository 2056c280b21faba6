"""The learned head's weights: their shapes, their file, and the robots that they are trained for."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import message, require
from torchelev.output_files import atomic_file
from torchelev.robot import RobotConfig
from torchelev.traversability.features import NUM_FEATURES

if TYPE_CHECKING:
    from jaxtyping import Float

RESOLUTIONS = (0.02, 0.1)  # [m]
ROUNDING = 1e-6  # of ratios
VERSION = 2  # of the file
CONFIG = {"cell_channels", "stance_channels", "ranges"}


class Weights(NamedTuple):
    """The head's parameters: C channels of each cell, D with those of its surroundings, S of each stance."""

    cell: Float[Tensor, "C F"]  #: of the features of a cell
    cell_bias: Float[Tensor, "C"]  #: added to it
    cell_condition: Float[Tensor, "C N"]  #: of the robot's ratios
    foot: Float[Tensor, "S D"]  #: of a cell with a foot on it
    center: Float[Tensor, "S D"]  #: of the cell under the body's centre
    attitude: Float[Tensor, "S 3"]  #: of its slope, step and belly
    stance_bias: Float[Tensor, "S"]  #: added to them
    stance_condition: Float[Tensor, "S N"]  #: of the robot's ratios
    mixed: Float[Tensor, "C S+2"]  #: of the means over headings, the last two of `stands` and `complete`
    mixed_bias: Float[Tensor, "C"]  #: added to it
    answer: Float[Tensor, "2 C"]  #: of the mixed channels, for both answers
    answer_bias: Float[Tensor, "2"]  #: added to it

    def detached(self) -> Weights:
        """Return the weights without gradient."""
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


def ratios(robot: RobotConfig, resolution: float) -> dict[str, float]:
    """Return what windows and dimensionless heights leave open of a robot's and the cells' sizes."""
    return {
        "robot.width / length": robot.width / robot.length,
        "robot.clearance / step_height": robot.clearance / robot.step_height,
        "robot.foot_radius / length": robot.foot_radius / robot.length,
        "robot.foot_reach / length": robot.foot_reach / robot.length,
        "tan(robot.max_slope) * length / step_height": math.tan(robot.max_slope) * robot.length / robot.step_height,
        "resolution / robot.length": resolution / robot.length,
        "robot.step_height": robot.step_height,  # [m] noise and drift have lengths of their own
    }


# Of the robots that weights are trained for unless they say otherwise.
RANGES = {
    "robot.width / length": (0.4, 0.8),
    "robot.clearance / step_height": (0.85, 3.4),
    "robot.foot_radius / length": (0.03, 0.06),
    "robot.foot_reach / length": (0.1, 0.2),
    "tan(robot.max_slope) * length / step_height": (0.88, 5.7),
    "resolution / robot.length": (0.02, 0.25),
    "robot.step_height": (0.06, 0.35),
}


def conditions(robot: RobotConfig, resolution: float) -> list[float]:
    """Return the ratios' logarithms, -1 to 1 over RANGES."""
    logs = ((math.log(ratio), *map(math.log, RANGES[name])) for name, ratio in ratios(robot, resolution).items())
    return [(2 * value - low - high) / (high - low) for value, low, high in logs]


def require_in_ranges(ranges: Mapping[str, tuple[float, float]], robot: RobotConfig, resolution: float) -> None:
    """Raise ValueError for a resolution that no head is made for, or a robot outside of the ranges."""
    low, high = RESOLUTIONS
    within = low * (1 - ROUNDING) <= resolution <= high * (1 + ROUNDING)
    require(within, "resolution", f"must be {low:g} to {high:g} m", resolution, "resample the map")
    hint = "train a head for this robot: python -m training.traversability --robot ..."
    for name, ratio in ratios(robot, resolution).items():
        low, high = ranges[name]
        within = low * (1 - ROUNDING) <= ratio <= high * (1 + ROUNDING)
        require(within, name, f"must be within {low:.3g} to {high:.3g}, as trained", f"{ratio:.4g}", hint)


def write_weights(path: str | Path, config: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Write a head's config and weights."""
    whole = io.BytesIO()  # into a file, torch raises RuntimeError where the disk is full
    torch.save({"version": VERSION, "config": dict(config), "state_dict": dict(state)}, whole)
    with atomic_file(path) as file:
        file.write(whole.getbuffer())


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the config and the weights of a file.

    Raises FileNotFoundError without the file, ValueError if it holds anything else, or weights of another version.
    """
    hint = "write it with TraversabilityNet.save"
    missing = "train weights: python -m training.traversability"
    require(path.exists(), str(path), "must be a file of weights", "no file", missing, FileNotFoundError)
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what torch raises depends on which byte is damaged
        raise ValueError(message(str(path), "must be a file of weights", type(error).__name__, hint)) from error
    version = found.get("version") if isinstance(found, dict) else None
    require(isinstance(version, int), str(path), "must be a file of weights", "something else", hint)
    require(version == VERSION, str(path), f"must be of version {VERSION}", version, "train with this torchelev")
    require(_is_whole(found), str(path), "must be a file of weights", "other parts or types", hint)
    return found["config"], found["state_dict"]


def _is_whole(found: dict[str, Any]) -> bool:
    """Tell whether a file's content has all parts, of their types."""
    config, state = found.get("config"), found.get("state_dict")
    if not isinstance(config, dict) or config.keys() != CONFIG or not isinstance(state, dict):
        return False
    ranges = config["ranges"]
    sizes = all(type(config[name]) is int and config[name] > 0 for name in ("cell_channels", "stance_channels"))
    tensors = all(isinstance(value, Tensor) for value in state.values())
    pairs = isinstance(ranges, dict) and ranges.keys() == RANGES.keys()
    return sizes and tensors and pairs and all(len(pair) == 2 for pair in ranges.values())


def require_same_shapes(path: Path, expected: Mapping[str, Tensor], actual: Mapping[str, Tensor]) -> None:
    """Raise ValueError unless weights have the shapes that they should, and are finite."""
    shapes, others = ({name: tuple(value.shape) for name, value in each.items()} for each in (expected, actual))
    differ = [name for name in shapes | others if shapes.get(name) != others.get(name)]
    text = ", ".join(f"{name} {others.get(name)} instead of {shapes.get(name)}" for name in differ)
    require(not differ, str(path), "must hold weights of the shapes that its config says", text, "train them again")
    wild = ", ".join(name for name, value in actual.items() if not bool(torch.isfinite(value).all()))
    require(not wild, str(path), "must be finite", f"NaN or inf in {wild}", "train them again")
