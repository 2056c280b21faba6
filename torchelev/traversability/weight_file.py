"""The learned head's weights: their shapes, the file that holds them, and the robots that they are trained for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor

from torchelev.errors import require
from torchelev.files.weight_files import WeightFormat, is_within, require_resolution
from torchelev.robot import RobotConfig
from torchelev.traversability.features import NUM_FEATURES

if TYPE_CHECKING:
    from jaxtyping import Float

VERSION = 2  # of the file format
_CONFIG_KEYS = {"cell_channels", "stance_channels", "ranges"}


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


def ratios(robot: RobotConfig, resolution: float) -> dict[str, float]:
    """Return a robot's proportions, which its windows and dimensionless heights do not contain."""
    return {
        "robot.width / length": robot.width / robot.length,
        "robot.clearance / step_height": robot.clearance / robot.step_height,
        "robot.foot_radius / length": robot.foot_radius / robot.length,
        "robot.foot_reach / length": robot.foot_reach / robot.length,
        "tan(robot.max_slope) * length / step_height": math.tan(robot.max_slope) * robot.length / robot.step_height,
        "resolution / robot.length": resolution / robot.length,
        "robot.step_height": robot.step_height,  # [m] as sensor noise and drift do not scale with the robot
    }


# Limits of the ratios of the robots that a head is trained for by default.
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
    """Return the logarithms of the ratios, scaled to -1 and 1 at the limits in RANGES."""
    logs = ((math.log(ratio), *map(math.log, RANGES[name])) for name, ratio in ratios(robot, resolution).items())
    return [(2 * value - low - high) / (high - low) for value, low, high in logs]


def require_in_ranges(ranges: Mapping[str, tuple[float, float]], robot: RobotConfig, resolution: float) -> None:
    """Refuse a resolution outside RESOLUTIONS, and a robot whose ratios are outside the ranges."""
    require_resolution(resolution)
    hint = "train a head for this robot: python -m training.traversability --robot ..."
    for name, ratio in ratios(robot, resolution).items():
        low, high = ranges[name]
        fits = is_within(ratio, ranges[name])
        require(fits, name, f"must be within {low:.3g} to {high:.3g}, as trained", f"{ratio:.4g}", hint)


def _is_config(config: dict[str, Any]) -> bool:
    """Return whether a config has all its parts, of the right types."""
    if config.keys() != _CONFIG_KEYS:
        return False
    ranges = config["ranges"]
    has_sizes = all(type(config[name]) is int and config[name] > 0 for name in ("cell_channels", "stance_channels"))
    has_ranges = isinstance(ranges, dict) and ranges.keys() == RANGES.keys()
    return has_sizes and has_ranges and all(len(pair) == 2 for pair in ranges.values())


FORMAT = WeightFormat(VERSION, _is_config, "TraversabilityNet.save", "python -m training.traversability")
