"""Reading a map: layers by name, ratings, and samples at points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.channels.module import Channels
from torchelev.config import ElevationMapConfig
from torchelev.errors import require
from torchelev.inputs import checks
from torchelev.layers import LAYERS, MODES, Layer, sample_layer, sample_lowest
from torchelev.levels import HINT as LEVEL_HINT
from torchelev.levels import LAYERS as LEVEL_LAYERS
from torchelev.levels import views
from torchelev.levels.functional import require_levels
from torchelev.levels.module import MapLevels
from torchelev.levels.state import Levels
from torchelev.maps.buffers import MapBuffers
from torchelev.stages.disagreement.stage import without_disagreement
from torchelev.stages.surface.stage import rate_surface
from torchelev.stages.surface.upper_bound import require_filter
from torchelev.state import MapState
from torchelev.traversability.heads import LearnedTraversabilityConfig, learned_rating, make_head
from torchelev.traversability.rating import Rating

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.filters.chain import FilterChain
    from torchelev.traversability.net import TraversabilityNet
    from torchelev.traversability.weight_file import Weights


class ReadableMap(MapBuffers):
    """B maps that can be read: with the networks and the filters that the config asks for.

    Args:
        cfg: configuration of all stages.
        num_envs: number of maps, B.
        device: device of the maps.
        head: trained head in place of the one that the config names.
    """

    def __init__(
        self,
        cfg: ElevationMapConfig,
        num_envs: int,
        device: torch.device | str,
        head: TraversabilityNet | None,
    ) -> None:
        super().__init__(cfg, num_envs, device)
        with torch.inference_mode(False):  # inference tensors could not be trained or written outside of that mode
            require_filter(cfg.surface)
            self.head = make_head(cfg.traversability, cfg.grid, head)
            self.channels = None
            if cfg.channels:
                self.channels = Channels(cfg.channels, cfg.grid, cfg.sensor, num_envs, device)
            self.levels = None
            if cfg.has_levels:
                self.levels = MapLevels(cfg, num_envs, device)
        if self.head is not None:
            self.head.to(device)
        self.filters = self._make_filters()
        self._derived: dict[str, Layer] = {}  # layers that filters made of the current state

    def _make_filters(self) -> FilterChain | None:
        """Return the filters that the config asks for."""
        if not self.cfg.filters:
            return None
        from torchelev.filters.chain import FilterChain  # a map without filters needs none of them

        return FilterChain(self.cfg.filters, self.cfg.grid.resolution, self._own_layers)

    def _forget_derived(self) -> None:
        self._derived.clear()

    @property
    def _weights(self) -> Weights | None:
        return None if self.head is None else self.head.weights

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of all layers: the map's, then those of the configured filters."""
        return (*self._own_layers, *(step.layer for step in self.cfg.filters))

    @property
    def _own_layers(self) -> tuple[str, ...]:
        channels = () if self.channels is None else self.channels.layers
        levels = () if self.levels is None else LEVEL_LAYERS
        return (*LAYERS, *levels, *channels)

    def layer(
        self, name: str, *, state: MapState | None = None, level: int | None = None, levels: Levels | None = None
    ) -> Float[Tensor, "B H W"]:
        """Return a layer as a fresh tensor, NaN where unknown.

        - elevation [m], variance [m^2], time [s] since the last hit: unknown where never measured, or cleared.
        - validity: 1 where the elevation is known, else 0.
        - upper_bound [m]: the elevation where known; elsewhere the height that rays passed above, which the ground does
          not exceed.
        - traversability, 0 (impassable) to 1, and normal_x, normal_y, normal_z of unit length: also unknown where the
          known neighbours do not span a plane. The learned head rates every known cell.
        - a channel's, or `<channel>.<component>` of one with several, such as "rgb.red". The channel of several
          components itself is (B, C, H, W). Unknown where no point, and no image, said anything of the ground.
        - ceiling [m], with `LevelsConfig`: the underside of the lowest surface above the ground, inf where rays met
          none, NaN where nobody looked; clearance [m]: its height above the ground.
        - a configured filter's: computed when read, with the layers that it needs, and kept until the map changes.

        Args:
            name: one of `layers`, or a channel.
            state: state to read; None: the map's own.
            level: read a surface's own elevation, underside, variance, time or validity: 0 is the lowest of each cell,
                k the one with k surfaces below it. None: the ground, on which the robot stands.
            levels: other surfaces to read, those of the state, as `forward` returns them; None: the map's own.

        Raises:
            KeyError: if there is no such layer.
            ValueError: if there is no such level.
        """
        if level is not None:
            values, known = self.read_level(name, level, state, levels)
            return torch.where(known, values, torch.nan)
        if name in self.cfg.channels and name not in self.layers:
            vectors, known = self.read_channel(name, state)
            return torch.where(known[..., None], vectors, torch.nan).movedim(-1, 1)
        values, known = self.read_layer(name, state, levels)
        return torch.where(known, values, torch.nan)

    def read_level(self, name: str, level: int, state: MapState | None = None, levels: Levels | None = None) -> Layer:
        """Return a layer of one surface of each cell, and where there is one; arguments and errors as of `layer`."""
        require(self.levels is not None, "level", "needs a map with levels", repr(level), LEVEL_HINT)
        return views.by_level(name, level, self._surfaces(state, levels))

    def _surfaces(self, state: MapState | None, levels: Levels | None) -> views.View:
        """Return all surfaces of the maps: the ground of a state, and the given others or the map's own."""
        assert self.levels is not None
        ground = self.state if state is None else state
        if levels is None:
            self._require_all(state)
        else:
            require_levels(levels, ground, self.cfg)
        return self.levels.view(ground, levels)

    def read_channel(
        self, name: str, state: MapState | None = None, cell: Int[Tensor, "B M"] | None = None
    ) -> tuple[Float[Tensor, "B *cells C"], Bool[Tensor, "B *cells"]]:
        """Return the values of a channel, and where they are known; errors as of `layer`.

        Args:
            name: of the channel.
            state: state to read; None: the map's own.
            cell: flat numbers i * W + j of the cells to read; None: all, as (B, H, W).
        """
        require(name in self.cfg.channels, "layer", "must be a channel", repr(name), "see cfg.channels", KeyError)
        assert self.channels is not None
        self._require_all(state)
        values, known = self.channels.read(name, state, cell)
        validity = (self.state if state is None else state).validity
        return values, known & (validity if cell is None else validity.flatten(1).gather(1, cell))

    def _require_all(self, state: MapState | None) -> None:
        """Refuse the state of some of the maps, where what is read is no part of it."""
        if state is not None:
            rule, actual = (
                f"must be of all {self.num_envs} maps, as channels and levels are no part of it",
                len(state.validity),
            )
            hint = "leave it out, and choose the environment afterwards"
            require(actual == self.num_envs, "state", rule, actual, hint)

    def load_state(self, state: MapState, levels: Levels | None = None) -> None:
        """Copy a state into the buffers, such as one that `forward` returned.

        Channels keep what fits its ground.

        Args:
            state: state of the same grid and number of environments; its values are converted to the map's dtype.
            levels: the other surfaces, as `forward` returned them; None: the map keeps its own.

        Raises:
            ValueError: if a tensor of the state has another shape, or the levels are not those of the state.
        """
        if levels is not None:
            require_levels(levels, state, self.cfg)
        super().load_state(state)
        if levels is not None and self.levels is not None:
            self.levels.put(levels, self.state)
        self._sync_channels()

    def _sync_channels(self) -> None:
        """Make channels and levels follow what changed besides updates, such as cells that were forgotten."""
        if self.levels is not None:
            self.levels.follow(self.state)
        if self.channels is not None:
            self.channels.follow(self.state)

    def read_layer(self, name: str, state: MapState | None = None, levels: Levels | None = None) -> Layer:
        """Return a layer's values and mask, for code that computes with both; arguments and errors as of `layer`.

        Returns:
            values: (B, H, W), arbitrary but finite where unknown.
            known: (B, H, W) bool. Both may share memory with the map: do not write into them.
        """
        if self.filters is None or name not in self.filters:
            return self._read_own(name, state, levels)
        if state is not None or levels is not None:
            return self.filters.read(name, lambda source: self.read_layer(source, state, levels), {})
        with torch.inference_mode(False), torch.no_grad():  # kept, and perhaps read outside of inference mode later
            return self.filters.read(name, self.read_layer, self._derived)

    def _read_own(self, name: str, state: MapState | None, levels: Levels | None) -> Layer:
        """Return a layer that no filter makes."""
        hint = self._hint_of(name)
        require(name in self._own_layers, "layer", "must be a layer's name", repr(name), hint, KeyError)
        if name in LEVEL_LAYERS:
            assert self.cfg.levels is not None
            return getattr(views, name)(self._surfaces(state, levels), self.cfg.levels.min_gap)  # type: ignore[no-any-return]
        if name not in LAYERS:
            channel = name.split(".")[0]
            values, known = self.read_channel(channel, state)
            return values[..., self.cfg.channels[channel].components(channel).index(name)], known
        return LAYERS[name](self.state if state is None else state)

    def _hint_of(self, name: str) -> str:
        """Return what to do about a layer that is not there."""
        if name in LEVEL_LAYERS:
            return LEVEL_HINT
        return f"there are {', '.join(self.layers)}"

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
            state = state._replace(variance=without_disagreement(state))  # as updates rate
            return learned_rating(state, self.cfg.grid, cfg, self._weights)
        rated = rate_surface(state, self.cfg.grid, self.cfg.surface, cfg)
        return Rating(rated.traversability, rated.rated.to(rated.traversability.dtype))

    def sample(
        self,
        xy: Float[Tensor, "B M 2"],
        layer: str = "elevation",
        mode: str = "bilinear",
        *,
        state: MapState | None = None,
        levels: Levels | None = None,
    ) -> tuple[Float[Tensor, "B M"], Bool[Tensor, "B M"]]:
        """Read a layer at points. Differentiable in the state and, if bilinear, in `xy`.

        Args:
            xy: points, map frame [m].
            layer: one of `layers`.
            mode: "bilinear" renormalises over the known ones of the four surrounding cells, and is valid where these
                carry at least half of the weight; of ceilings and clearance it takes the lowest. "nearest" reads the
                cell that holds the point.
            state: state to read; None: the map's own.
            levels: other surfaces to read, as of `layer`.

        Returns:
            values: (B, M), 0 where not valid.
            valid: (B, M) bool.

        Raises:
            KeyError: if there is no such layer.
            TypeError: if `xy` is not a tensor of floats.
            ValueError: if the mode is unknown, or `xy` has another shape or device.
        """
        xy = checks.check_xy("xy", xy, self.num_envs, self.device)
        require(mode in MODES, "mode", f"must be one of {', '.join(MODES)}", repr(mode), "use bilinear")
        corner = (self.state if state is None else state).corner
        uv = (xy.double() / self.cfg.grid.resolution - corner[:, None]).to(self.elevation.dtype)
        sample = sample_lowest if layer in LEVEL_LAYERS else sample_layer
        return sample(self.read_layer(layer, state, levels), uv, self.cfg.grid, mode)
