"""Reading a map: layers by name, ratings, and samples at points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.config import ElevationMapConfig
from torchelev.errors import require
from torchelev.filters.chain import FilterChain
from torchelev.inputs import checks
from torchelev.layers import LAYERS, MODES, Layer, sample_layer
from torchelev.map_buffers import MapBuffers
from torchelev.pipeline import rate_surface
from torchelev.state import MapState
from torchelev.traversability.heads import LearnedTraversabilityConfig, learned_rating, make_head
from torchelev.traversability.net import Rating, TraversabilityNet
from torchelev.traversability.weight_file import Weights

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class ReadableMap(MapBuffers):
    """B maps that can be read: with the trained head and the filters that the config asks for.

    Args:
        cfg: configuration of all stages.
        num_envs: number of maps, B.
        device: device of the maps.
        head: trained head in place of the one that the config names.
    """

    def __init__(
        self, cfg: ElevationMapConfig, num_envs: int, device: torch.device | str, head: TraversabilityNet | None
    ) -> None:
        super().__init__(cfg, num_envs, device)
        with torch.inference_mode(False):  # inference tensors could not be trained or written outside of that mode
            self.head = make_head(cfg.traversability, cfg.grid, head)
        if self.head is not None:
            self.head.to(device)
        self.filters = FilterChain(cfg.filters, cfg.grid.resolution)
        self._filtered: dict[str, Layer] = {}  # layers that filters made of the current state

    def _forget_derived(self) -> None:
        self._filtered.clear()

    @property
    def _weights(self) -> Weights | None:
        return None if self.head is None else self.head.weights

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of all layers: the map's, then those of the configured filters."""
        return (*LAYERS, *self.filters.inputs)

    def layer(self, name: str, *, state: MapState | None = None) -> Float[Tensor, "B H W"]:
        """Return a layer as a fresh tensor, NaN where unknown.

        - elevation [m], variance [m^2], time [s] since the last hit: unknown where never measured, or cleared.
        - validity: 1 where the elevation is known, else 0.
        - upper_bound [m]: the elevation where known; elsewhere the height that rays passed above, which the ground does
          not exceed.
        - traversability, 0 (impassable) to 1, and normal_x, normal_y, normal_z of unit length: also unknown where the
          known neighbours do not span a plane. The learned head rates every known cell.
        - a configured filter's: computed when read, with the layers that it needs, and kept until the map changes.

        Args:
            name: one of `layers`.
            state: state to read; None: the map's own.

        Raises:
            KeyError: if there is no such layer.
        """
        values, known = self.read_layer(name, state)
        return torch.where(known, values, torch.nan)

    def read_layer(self, name: str, state: MapState | None = None) -> Layer:
        """Return a layer's values and mask, for code that computes with both; arguments and errors as of `layer`.

        Returns:
            values: (B, H, W), arbitrary but finite where unknown.
            known: (B, H, W) bool. Both may share memory with the map: do not write into them.
        """
        if name not in self.filters:
            hint = f"there are {', '.join(self.layers)}"
            require(name in LAYERS, "layer", "must be a layer's name", repr(name), hint, KeyError)
            return LAYERS[name](self.state if state is None else state)
        if state is not None:
            return self.filters.read(name, lambda source: self.read_layer(source, state), {})
        with torch.inference_mode(False), torch.no_grad():  # kept, and perhaps read outside of inference mode later
            return self.filters.read(name, self.read_layer, self._filtered)

    def rate(self, *, state: MapState | None = None) -> Rating:
        """Return traversability and its confidence, (B, H, W) each, 0 to 1.

        The learned head also rates unknown cells; far from known ground both are averages of its training data. Its
        confidence is the probability that "traversability >= 0.5" is correct. The analytic head's confidence is 1 for
        the cells that it can rate, and both are 0 elsewhere. Differentiable in the state and in the weights of `head`.

        Args:
            state: state to rate; None: the map's own.

        Raises:
            ValueError: if traversability is switched off.
        """
        state, cfg = self.state if state is None else state, self.cfg.traversability
        require(cfg is not None, "cfg.traversability", "must not be None", None, "give a TraversabilityConfig")
        if isinstance(cfg, LearnedTraversabilityConfig) and self._weights is not None:
            return learned_rating(state, self.cfg.grid, cfg, self._weights)
        rated = rate_surface(state, self.cfg)
        return Rating(rated.traversability, rated.rated.to(rated.traversability.dtype))

    def sample(
        self,
        xy: Float[Tensor, "B M 2"],
        layer: str = "elevation",
        mode: str = "bilinear",
        *,
        state: MapState | None = None,
    ) -> tuple[Float[Tensor, "B M"], Bool[Tensor, "B M"]]:
        """Read a layer at points. Differentiable in the state and, if bilinear, in `xy`.

        Args:
            xy: points, map frame [m].
            layer: one of `layers`.
            mode: "bilinear" renormalises over the known ones of the four surrounding cells, and is valid where these
                carry at least half of the weight; "nearest" reads the cell that holds the point.
            state: state to read; None: the map's own.

        Returns:
            values: (B, M), 0 where not valid.
            valid: (B, M) bool.

        Raises:
            KeyError: if there is no such layer.
            TypeError: if `xy` is no tensor of floats.
            ValueError: if the mode is unknown, or `xy` has another shape or device.
        """
        xy = checks.check_xy("xy", xy, self.num_envs, self.device)
        require(mode in MODES, "mode", f"must be one of {', '.join(MODES)}", repr(mode), "use bilinear")
        corner = (self.state if state is None else state).corner
        uv = (xy.double() / self.cfg.grid.resolution - corner[:, None]).to(self.elevation.dtype)
        return sample_layer(self.read_layer(layer, state), uv, self.cfg.grid, mode)
