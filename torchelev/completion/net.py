"""The completion network: a module that predicts the ground at every cell, with its standard deviation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchelev.completion.complete import Completion, CompletionInput, complete
from torchelev.completion.parameters import Weights, weight_shapes
from torchelev.errors import require
from torchelev.files.weight_files import WeightFormat, require_resolution, write_weights
from torchelev.ops.transforms import require_reverse_mode

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

VERSION = 2  # of the file format; raised also when the features change
_PRETRAINED = Path(__file__).parent / "weights" / "completion.pt"
_SIZES = ("view_channels", "cell_channels", "measured_channels")


class CompletionNet(nn.Module):
    """Predicts the ground at every cell of a map of any size: mean and standard deviation.

    Altitude shifts the mean and nothing else. Whole-cell shifts, quarter turns and mirrors commute with it. For
    resolutions of 2 to 10 cm.

    Args:
        view_channels: width of the layers that describe one direction.
        cell_channels: width of the layers that describe a cell.
        measured_channels: width of the layer that describes a measured cell.
    """

    def __init__(self, view_channels: int = 8, cell_channels: int = 24, measured_channels: int = 8) -> None:
        super().__init__()
        self.config: dict[str, Any] = dict(zip(_SIZES, (view_channels, cell_channels, measured_channels), strict=True))
        for name, shape in weight_shapes(**self.config).items():
            self.register_parameter(name, nn.Parameter(torch.zeros(shape)))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialise the weights at random."""
        for name, value in self.named_parameters():
            if value.ndim == 2 and not name.endswith("bias"):
                nn.init.kaiming_uniform_(value, a=1)
            else:
                nn.init.zeros_(value)

    @property
    def weights(self) -> Weights:
        """The parameters, as `complete` takes them."""
        return Weights(*(getattr(self, name) for name in Weights._fields))

    def forward(
        self,
        elevation: Float[Tensor, "B H W"],
        validity: Bool[Tensor, "B H W"],
        variance: Float[Tensor, "B H W"] | None = None,
        upper_bound: Float[Tensor, "B H W"] | None = None,
        bounded: Bool[Tensor, "B H W"] | None = None,
        age: Float[Tensor, "B H W"] | None = None,
        *,
        resolution: float,
    ) -> Completion:
        """Predict the ground at every cell of B maps.

        Measured cells stay within two standard deviations of their elevation. Unknown cells do not rise above their
        upper bound. In a map without a known cell, the mean is 0, or the upper bound below it, and the standard
        deviation the prior's.

        Args:
            elevation: heights [m] within 1000 km of 0, arbitrary where not valid. Cells whose height, variance or age
                is not finite count as unknown.
            validity: True where the elevation is known.
            variance: of the elevation [m^2]; None: the heights are exact.
            upper_bound: of the ground [m] where its elevation is unknown; arbitrary where not bounded.
            bounded: True where the upper bound is known; None, together with `upper_bound`: nowhere.
            age: [s] since the last measurement; None: they are new.
            resolution: of the maps [m], 0.02 to 0.1.

        Returns:
            Mean and standard deviation [m], (B, H, W) each, finite everywhere.

        Raises:
            TypeError: if a layer has another dtype than the weights, a mask is not of bool, or the weights are of half
                precision.
            ValueError: if a layer has another shape or device, or the resolution is out of range.
            NotImplementedError: in forward-mode differentiation, and if `torch.func.vmap` batches an input.
        """
        require_resolution(resolution)
        require_reverse_mode([elevation, validity, variance, upper_bound, bounded, age, *self.weights])
        layers = _check_layers(self.weights.prior, elevation, validity, variance, upper_bound, bounded, age)
        return complete(self.weights, layers, resolution)

    def save(self, path: str | Path) -> None:
        """Write config and weights to a file, for `from_pretrained`.

        Raises:
            WriteError: if the file cannot be written.
        """
        write_weights(path, VERSION, self.config, self.state_dict())

    @classmethod
    def from_pretrained(cls, path: str | Path | None = None) -> CompletionNet:
        """Build a network from a file that `save` wrote.

        Args:
            path: the file; None: the weights that come with torchelev.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it does not hold finite weights of this version.
        """
        return _FORMAT.build(_PRETRAINED if path is None else Path(path), cls)


def _is_config(config: dict[str, Any]) -> bool:
    return config.keys() == set(_SIZES) and all(type(size) is int and size > 0 for size in config.values())


_FORMAT = WeightFormat(VERSION, _is_config, "CompletionNet.save", "python -m training.completion")


def _check_layers(
    weight: Tensor,
    elevation: Any,
    validity: Any,
    variance: Any,
    upper_bound: Any,
    bounded: Any,
    age: Any,
) -> CompletionInput:
    """Return the layers, those that are None filled in."""
    is_pair = (upper_bound is None) == (bounded is None)
    require(is_pair, "upper_bound, bounded", "must come together", "one of them", "give both or none")
    given = (elevation, validity, variance, upper_bound, bounded, age)
    for name, layer in zip(CompletionInput._fields, given, strict=True):
        is_layer = isinstance(layer, Tensor) or (layer is None and name not in ("elevation", "validity"))
        require(is_layer, name, "must be a tensor", type(layer).__name__, "give a layer", TypeError)
    rule, kinds = "must be of float32 or float64", (torch.float32, torch.float64)
    require(weight.dtype in kinds, "weights", rule, weight.dtype, "convert the network with .float()", TypeError)
    is_map = elevation.ndim == 3 and elevation.numel() > 0
    require(is_map, "elevation", "must be (B, H, W), not empty", tuple(elevation.shape), "give (B, H, W)")
    zero, nowhere = torch.zeros_like(elevation), torch.zeros_like(validity)
    blank = (zero, nowhere, zero, zero, nowhere, zero)
    layers = CompletionInput(*(b if layer is None else layer for layer, b in zip(given, blank, strict=True)))
    shape, device = tuple(elevation.shape), weight.device
    for name, layer in layers._asdict().items():
        dtype = torch.bool if name in ("validity", "bounded") else weight.dtype
        actual, hint = f"{tuple(layer.shape)} on {layer.device}", "give the map's layers, and move the network to them"
        require(layer.dtype == dtype, name, f"must be {dtype}", layer.dtype, "convert it with .to()", TypeError)
        fits = tuple(layer.shape) == shape and layer.device == device
        require(fits, name, f"must be {shape} on {device}", actual, hint)
    validity = validity & elevation.isfinite() & layers.variance.isfinite() & layers.age.isfinite()
    return layers._replace(validity=validity, bounded=layers.bounded & layers.upper_bound.isfinite())
