"""The learned traversability head: a module that rates where a legged robot can stand, with its confidence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchelev.errors import require
from torchelev.robot import RobotConfig
from torchelev.traversability.rate import rate
from torchelev.traversability.rating import Rating
from torchelev.traversability.trained_range import RANGES, require_in_ranges
from torchelev.traversability.weight_file import Weights, read_weights, weight_shapes, write_weights

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_PRETRAINED = Path(__file__).parent / "weights" / "traversability.pt"


class TraversabilityNet(nn.Module):
    """Rates every cell of a map: can a legged robot stand with its body over that cell?

    Altitude does not change a rating, and ratings turn and mirror with the map. For resolutions of 2 to 10 cm.

    Args:
        cell_channels: width of the layer that describes a cell.
        stance_channels: width of the layer that rates a robot at one heading.
        ranges: limits of the ratios (`trained_range.ratios`) of the robots that the head is trained for; None: RANGES.
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
        """Initialise the weights at random."""
        for name, value in self.named_parameters():
            if name.endswith(("bias", "condition")):
                nn.init.zeros_(value)
            else:
                nn.init.kaiming_uniform_(value, a=1)

    @property
    def weights(self) -> Weights:
        """The parameters, as `rate` takes them."""
        return Weights(*(getattr(self, name) for name in Weights._fields))

    def require_trained(self, robot: RobotConfig, resolution: float) -> None:
        """Refuse a robot or a resolution that the head is not trained for.

        Raises:
            ValueError: naming the ratio that is out of range.
        """
        require_in_ranges(self.ranges, robot, resolution)

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

        Cells with no known ground within the robot's reach get the average of the training data.

        Args:
            elevation: heights [m], arbitrary where not valid; heights that are not finite count as unknown.
            validity: True where the elevation is known.
            variance: of the elevation [m^2]; None: the heights are exact.
            upper_bound: of the ground [m] where its elevation is unknown; arbitrary where not bounded.
            bounded: True where the upper bound is known; None, together with `upper_bound`: nowhere.
            resolution: of the maps [m], 0.02 to 0.1.
            robot: robot to rate the ground for.

        Raises:
            ValueError: if a layer has another shape or dtype, or the resolution or the robot is out of range.
        """
        layers = (elevation, validity, variance, upper_bound, bounded)
        return Rating(*(logit.sigmoid() for logit in self.logits(*layers, resolution=resolution, robot=robot)))

    def logits(
        self, *layers: Tensor | None, resolution: float, robot: RobotConfig, **named_layers: Tensor | None
    ) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
        """Return the logits of traversability and confidence, for training; arguments and errors as of `forward`."""
        self.require_trained(robot, resolution)
        weights = self.weights
        return rate(weights, *_check_layers(weights.cell, *layers, **named_layers), resolution=resolution, robot=robot)

    def save(self, path: str | Path) -> None:
        """Write config and weights to a file, for `from_pretrained`.

        Raises:
            WriteError: if the file cannot be written.
        """
        write_weights(path, self.config, self.state_dict())

    @classmethod
    def from_pretrained(cls, path: str | Path | None = None) -> TraversabilityNet:
        """Build a head from a file that `save` wrote.

        Args:
            path: the file; None: the weights that come with torchelev.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it does not hold finite weights of this version.
        """
        config, state = read_weights(_PRETRAINED if path is None else Path(path))
        net = cls(**config)
        net.load_state_dict(state)
        return net


def _check_layers(
    weight: Tensor,
    elevation: Any,
    validity: Any,
    variance: Any = None,
    upper_bound: Any = None,
    bounded: Any = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return all five layers (B, H, W): floats of the weights' dtype, masks of bool, all on the weights' device."""
    is_pair = (upper_bound is None) == (bounded is None)
    require(is_pair, "upper_bound, bounded", "must come together", "one of them", "give both or none")
    zero = torch.zeros_like(elevation)
    layers: dict[str, Tensor] = {
        "elevation": elevation,
        "validity": validity,
        "variance": zero if variance is None else variance,
        "upper_bound": zero if upper_bound is None else upper_bound,
        "bounded": torch.zeros_like(validity) if bounded is None else bounded,
    }
    shape, device = tuple(elevation.shape), weight.device
    require(elevation.ndim == 3, "elevation", "must be (B, H, W)", shape, "add a dimension")
    for name, layer in layers.items():
        dtype = torch.bool if name in ("validity", "bounded") else weight.dtype
        fits = tuple(layer.shape) == shape and layer.dtype == dtype and layer.device == device
        actual = f"{tuple(layer.shape)} {layer.dtype} on {layer.device}"
        hint = "give the map's layers as they are, and move the head with .to(elevation)"
        require(fits, name, f"must be {shape} {dtype} on {device}", actual, hint)
    layers["validity"] = validity & elevation.isfinite()
    elevation, validity, variance, upper_bound, bounded = layers.values()
    return elevation, validity, variance, upper_bound, bounded
