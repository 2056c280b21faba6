"""The learned traversability head: where a legged robot can stand on the map, and how sure that is."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchelev.errors import require
from torchelev.ops.storage import realize, realize_all
from torchelev.ops.windows import shifted
from torchelev.robot import RobotConfig
from torchelev.traversability.attitude import attitudes
from torchelev.traversability.features import complete, extremes, features, widened_maximum
from torchelev.traversability.stances import Scales, in_cells
from torchelev.traversability.weight_file import (
    RANGES,
    Weights,
    conditions,
    read_weights,
    require_in_ranges,
    require_same_shapes,
    weight_shapes,
    write_weights,
)

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

PRETRAINED = Path(__file__).parent / "weights" / "traversability.pt"


class Rating(NamedTuple):
    """What the head says of every cell."""

    traversability: Float[Tensor, "B H W"]  #: 0 to 1, the share of headings at which the robot stands there
    confidence: Float[Tensor, "B H W"]  #: 0 to 1, the probability that "traversability >= 0.5" is right


def _biased(bias: Tensor, weight: Tensor, values: list[float]) -> Tensor:
    """Return bias + weight @ values; floats become constants of a compiled graph, where a tensor would be copied."""
    for column, value in zip(weight.unbind(1), values, strict=True):
        bias = torch.add(bias, column, alpha=value)
    return realize(bias)  # or every cell would compute it anew


def _mixed(
    weight: Float[Tensor, "O C"], layers: Sequence[Tensor], bias: Float[Tensor, "O"] | None = None
) -> Float[Tensor, "B O H W"]:
    """Mix channels (B, H, W), cell by cell."""
    if torch.compiler.is_compiling() and weight.device.type == "cpu" and not torch.is_grad_enabled():
        # In one pass: a third of the time that a product of so slim matrices takes.
        pairs = [zip(row.unbind(), layers, strict=True) for row in weight.unbind()]
        rows = [functools.reduce(torch.add, (share * layer for share, layer in row)) for row in pairs]
        rows = rows if bias is None else [row + part for row, part in zip(rows, bias.unbind(), strict=True)]
        return torch.stack(rows, 1)
    values = torch.stack(tuple(layers), 1)
    mixed = torch.bmm(weight.expand(len(values), -1, -1), values.flatten(2)).unflatten(2, values.shape[2:])
    return mixed if bias is None else mixed + bias[:, None, None]


def _spread(weight: Float[Tensor, "O C"], values: Sequence[Tensor]) -> Float[Tensor, "B O H W"]:
    """Mix a few layers (B, H, W) without a copy of them all."""
    columns = zip(weight.unbind(1), realize_all(*values), strict=True)
    return functools.reduce(torch.add, (column[:, None, None] * value[:, None] for column, value in columns))


def best_in_reach(cell: Tensor, scales: Scales) -> Tensor:
    """Return each channel's lowest value within a foot's reach, where a foot may choose its place."""
    return -widened_maximum(-cell, (*scales.steps[0], *scales.steps[1]))


def _sum_of_four(places: list[Tensor]) -> Tensor:
    """Add in an order that turns and mirrors, which exchange a with d or b with c, leave as it is to rounding."""
    a, b, c, d = places
    return (a + d) + (b + c)


def rate(
    weights: Weights,
    elevation: Float[Tensor, "B H W"],
    validity: Bool[Tensor, "B H W"],
    variance: Float[Tensor, "B H W"],
    upper_bound: Float[Tensor, "B H W"],
    bounded: Bool[Tensor, "B H W"],
    *,
    resolution: float,
    robot: RobotConfig,
) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
    """Return the logits of traversability and confidence, in float32 at least.

    Every cell is described by its surroundings. The body is put over each cell at four headings: what its feet stand
    on, how it is inclined and what is between them tell whether it stands there; the headings' mean tells of all.
    """
    dtype = torch.promote_types(elevation.dtype, torch.float32)  # half precision has no room for shares of windows
    weights = Weights(*(weight.to(dtype) for weight in weights))
    elevation, variance, upper_bound = (layer.to(dtype) for layer in (elevation, variance, upper_bound))
    scales = in_cells(robot, resolution)
    ground = complete(elevation, validity, variance, upper_bound, bounded, scales)
    extreme = extremes(ground, scales)
    sizes = conditions(robot, resolution)

    seen = features(ground, extreme, scales, resolution, robot)
    cell = F.relu(_mixed(weights.cell, seen, _biased(weights.cell_bias, weights.cell_condition, sizes)))
    around = [*shifted(cell, scales.reach).unbind(1), *best_in_reach(cell.chunk(2, 1)[0], scales).unbind(1)]
    foot, around = _mixed(weights.foot, around), [shifted(layer, scales.foot) for layer in around]
    center = _mixed(weights.center, around, _biased(weights.stance_bias, weights.stance_condition, sizes))

    mean = torch.zeros_like(center)
    standing, share = attitudes(ground, extreme, scales, robot, resolution), 1 / len(scales.stances)
    for stance, attitude in zip(scales.stances, standing, strict=True):
        stood_on = _sum_of_four([shifted(foot, scales.foot, *place) for place in stance.feet])
        tilted = _spread(weights.attitude, (attitude.slope, attitude.step, attitude.belly))
        mean = mean + F.relu(stood_on + center + tilted)
    columns = zip(*((attitude.stands, attitude.complete) for attitude in standing), strict=True)
    verdicts = [functools.reduce(torch.add, column) * share for column in columns]
    mixed = F.relu(_mixed(weights.mixed, [*(mean * share).unbind(1), *verdicts], weights.mixed_bias))
    traversability, confidence = _mixed(weights.answer, mixed.unbind(1), weights.answer_bias).unbind(1)
    return traversability, confidence


class TraversabilityNet(nn.Module):
    """Says of every cell of a map where a legged robot, its body over that cell, can stand.

    Unchanged by altitude, and turned and mirrored with the map; cells of 2 to 10 cm, robots within `ranges`.

    Args:
        cell_channels: C, numbers that describe a cell.
        stance_channels: S, numbers that describe a stance.
        ranges: of the robots that it is trained for, by the names in `ratios`; None: RANGES.
    """

    def __init__(
        self,
        cell_channels: int = 8,
        stance_channels: int = 8,
        ranges: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        super().__init__()
        ranges = RANGES if ranges is None else ranges
        self.ranges = {name: (float(low), float(high)) for name, (low, high) in ranges.items()}
        self.config: dict[str, Any] = {
            "cell_channels": cell_channels,
            "stance_channels": stance_channels,
            "ranges": self.ranges,
        }
        for name, shape in weight_shapes(cell_channels, stance_channels).items():
            self.register_parameter(name, nn.Parameter(torch.zeros(shape)))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw new weights."""
        for name, value in self.named_parameters():
            if name.endswith(("bias", "condition")):
                nn.init.zeros_(value)
            else:
                nn.init.kaiming_uniform_(value, a=1)

    @property
    def weights(self) -> Weights:
        """The parameters, for `rate`."""
        return Weights(*(getattr(self, name) for name in Weights._fields))

    def require_trained(self, robot: RobotConfig, resolution: float) -> None:
        """Raise ValueError for a robot or a resolution that the head is not made for."""
        require_in_ranges(self.ranges, robot, resolution)

    def logits(
        self,
        elevation: Float[Tensor, "B H W"],
        validity: Bool[Tensor, "B H W"],
        variance: Float[Tensor, "B H W"] | None = None,
        upper_bound: Float[Tensor, "B H W"] | None = None,
        bounded: Bool[Tensor, "B H W"] | None = None,
        *,
        resolution: float,
        robot: RobotConfig,
    ) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
        """Return the logits of traversability and confidence, which training fits; arguments as `forward`'s."""
        self.require_trained(robot, resolution)
        nothing = torch.zeros_like(elevation)
        variance = nothing if variance is None else variance
        both = (upper_bound is None) == (bounded is None)
        require(both, "upper_bound, bounded", "must come together", "one of them", "give both or none")
        if upper_bound is None or bounded is None:
            upper_bound, bounded = nothing, torch.zeros_like(validity)
        layers = (elevation, validity, variance, upper_bound, bounded)
        _check_layers(layers, self.weights.cell)
        layers = elevation, validity & elevation.isfinite(), variance, upper_bound, bounded
        return rate(self.weights, *layers, resolution=resolution, robot=robot)

    def forward(
        self,
        elevation: Float[Tensor, "B H W"],
        validity: Bool[Tensor, "B H W"],
        variance: Float[Tensor, "B H W"] | None = None,
        upper_bound: Float[Tensor, "B H W"] | None = None,
        bounded: Bool[Tensor, "B H W"] | None = None,
        *,
        resolution: float,
        robot: RobotConfig,
    ) -> Rating:
        """Rate every cell of B maps for one robot.

        Args:
            elevation: heights [m]; anything where not valid; what is not finite counts as unknown.
            validity: where the elevation is known.
            variance: of the elevation [m^2]; None: the heights are exact.
            upper_bound: of the ground [m] where it is not known; anything where not bounded.
            bounded: where the upper bound is known; None, with the bound: nowhere.
            resolution: of the maps [m], 0.02 to 0.1.
            robot: whose sizes count.

        Cells of which nothing is known within the robot's reach get the answer that training gives to unknown ground.

        Raises ValueError for layers of other shapes or types, and for a resolution or a robot out of range.
        """
        logits = self.logits(elevation, validity, variance, upper_bound, bounded, resolution=resolution, robot=robot)
        return Rating(*(torch.sigmoid(logit) for logit in logits))

    def save(self, path: str | Path) -> None:
        """Write the weights, for `from_pretrained`."""
        write_weights(path, self.config, self.state_dict())

    @classmethod
    def from_pretrained(cls, path: str | Path | None = None) -> TraversabilityNet:
        """Build a head with the weights of a file; None: those that come with torchelev.

        Raises FileNotFoundError if there is no such file, ValueError if it holds no weights of this version.
        """
        path = PRETRAINED if path is None else Path(path)
        config, state = read_weights(path)
        net = cls(**config)
        require_same_shapes(path, net.state_dict(), state)
        net.load_state_dict(state)
        return net


def _check_layers(layers: tuple[Tensor, ...], weight: Tensor) -> None:
    """Refuse layers that are not (B, H, W) alike, heights that are not of the weights' type and masks not of bool."""
    elevation = layers[0]
    shape, device = tuple(elevation.shape), weight.device
    require(elevation.ndim == 3, "elevation", "must be (B, H, W)", shape, "add a dimension")
    for name, layer in zip(("elevation", "validity", "variance", "upper_bound", "bounded"), layers, strict=True):
        dtype = torch.bool if name in ("validity", "bounded") else weight.dtype
        alike = tuple(layer.shape) == shape and layer.dtype == dtype and layer.device == device
        actual = f"{tuple(layer.shape)} {layer.dtype} on {layer.device}"
        hint = "give the map's layers as they are, and move the head with .to(elevation)"
        require(alike, name, f"must be {shape} {dtype} on {device}", actual, hint)
