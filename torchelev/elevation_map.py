"""The map: state and configuration, and the order of the stages."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import TYPE_CHECKING, Any, cast, overload

import torch
from torch import Tensor, nn

from torchelev import checks, pipeline
from torchelev.compiled_update import compile_ahead, compiled_update
from torchelev.config import ElevationMapConfig, differing_fields
from torchelev.diagnosis.causes import diagnose
from torchelev.diagnosis.pace import Pace, paced
from torchelev.diagnosis.recent import Recent
from torchelev.errors import require, require_count
from torchelev.filters.chain import FilterChain
from torchelev.grid import cell_centers, window_center
from torchelev.layers import LAYERS, Layer, sample_layer
from torchelev.ops.storage import keep_freed_memory
from torchelev.ops.transforms import require_reverse_mode
from torchelev.pipeline import rate_surface, update_in_place, write
from torchelev.stages.initialize import METHODS, initialize
from torchelev.stages.measure import measure
from torchelev.state import MapState, Measurement, Statistics, blank_state, forget, map_layers
from torchelev.traversability.heads import LearnedTraversabilityConfig, learned_rating, make_head
from torchelev.traversability.net import Rating, TraversabilityNet, Weights

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

CPU_CELLS = 2**18  # cells updated at a time on a CPU; measured: 64 maps of 64 x 64 cells, a third faster than 256


class ElevationMap(nn.Module):
    """B robot-centric elevation maps on one device.

    Args:
        cfg: the configuration, of every stage.
        num_envs: B, how many maps.
        device: where they live; `.to()` moves them.
        check_values: also check pose matrices, tensor `dt` and ids on devices other than the CPU, which makes the host
            wait for the device. Otherwise an environment there whose pose is not finite takes in no points and its
            window stays, and no time passes in a bad `dt`.
        chunk: update at most so many environments at a time, for less memory and, to rounding, the same result.
            None: all on a GPU; on a CPU as many as fit into its caches, which is faster too.
        head: a trained head to take, itself and not a copy, in place of the weights that the config names.

    Raises ValueError or TypeError for bad arguments, naming the argument, the rule, the actual value and a hint.
    """

    corner: Tensor
    base_height: Tensor
    elevation: Tensor

    def __init__(
        self,
        cfg: ElevationMapConfig | None = None,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        check_values: bool = False,
        chunk: int | None = None,
        head: TraversabilityNet | None = None,
    ) -> None:
        super().__init__()
        cfg = ElevationMapConfig() if cfg is None else cfg
        config = isinstance(cfg, ElevationMapConfig)
        require(
            config, "cfg", "must be an ElevationMapConfig", type(cfg).__name__, "wrap grid=GridConfig(...)", TypeError
        )
        self.num_envs = require_count("num_envs", num_envs, "give the number of maps")
        self.chunk = None if chunk is None else require_count("chunk", chunk, "give a number of environments, or None")
        self.cfg, self.check_values = cfg, check_values
        self._compiled = False
        self._pace = Pace()
        self._recent = Recent()
        self._stages = dataclasses.replace(cfg, filters=())  # of what an update does; compiled ones are found by it
        self.filters = FilterChain(cfg.filters, cfg.grid.resolution)
        self._filtered: dict[str, Layer] = {}  # what filters made of the stored state
        with torch.inference_mode(False):  # else no later call outside of that mode could write into it
            self.head = make_head(cfg.traversability, cfg.grid, head)
            state = blank_state(cfg.grid, self.num_envs, device, torch.float32)
        for name, value in state._asdict().items():
            if name != "statistics":
                self.register_buffer(name, value)
        for name, value in state.statistics._asdict().items():
            self.register_buffer(f"last_{name}", value, persistent=False)
        if self.head is not None:
            self.head.to(device)

    # The state ------------------------------------------------------------------------------------------------------

    @property
    def device(self) -> torch.device:
        """The device that holds the maps."""
        return self.elevation.device

    @property
    def state(self) -> MapState:
        """The maps' buffers as one value. They change with the next update; clone what you keep."""
        buffers = cast("dict[str, Tensor]", self._buffers)  # reading attributes takes five times as long
        layers = {name: buffers[name] for name in MapState._fields[:-1]}
        statistics = Statistics(*(buffers[f"last_{name}"] for name in Statistics._fields))
        return MapState(**layers, statistics=statistics)

    @property
    def statistics(self) -> Statistics:
        """What the last update did, as fresh (B,) tensors."""
        return Statistics(*(value.clone() for value in self.state.statistics))

    def _store(self, state: MapState) -> None:
        # Copied, not rebound: see the rules on deepcopy and inference mode in CONTRIBUTING.md.
        self._filtered.clear()
        with torch.no_grad():
            write(self.state, state)

    def get_extra_state(self) -> dict[str, Any]:
        """Return the config as plain dicts, for `state_dict`."""
        return {"config": self.cfg.to_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Do nothing: the config was compared before anything was loaded."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Refuse a checkpoint of another config, naming the settings that differ, before anything changed."""
        extra = state_dict.get(f"{prefix}_extra_state")
        # Filters hold no state, and the head's weights are loaded from here, whatever file they came from.
        apart = ("filters", "traversability.weights")
        fields = differing_fields(self.cfg.to_dict(), extra["config"]) if extra else []
        fields = [name for name in fields if not name.startswith(apart)]
        hint = "build the map with ElevationMapConfig.from_dict(checkpoint['_extra_state']['config'])"
        require(not fields, "state_dict", "must be of the same config", f"other {', '.join(fields)}", hint)
        self._filtered.clear()
        self._recent.forget()
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _apply(self, *args: Any, **kwargs: Any) -> ElevationMap:
        self._filtered.clear()
        self._recent.forget()
        return super()._apply(*args, **kwargs)

    # Writing --------------------------------------------------------------------------------------------------------

    # Overloads, so that type checkers ask for dt: it follows an argument that may be left out.
    @overload
    def update(
        self,
        points: Tensor,
        T_map_sensor: Tensor,
        T_map_base: Tensor | None,
        dt: float | Tensor,
        *,
        variance: Tensor | None = None,
    ) -> None: ...
    @overload
    def update(
        self, points: Tensor, T_map_sensor: Tensor, *, dt: float | Tensor, variance: Tensor | None = None
    ) -> None: ...
    @paced
    def update(
        self,
        points: Float[Tensor, "B *S N 3"],
        T_map_sensor: Float[Tensor, "B *S 4 4"],
        T_map_base: Float[Tensor, "B 4 4"] | None = None,
        dt: float | Float[Tensor, "B"] | None = None,
        *,
        variance: Float[Tensor, "B *S N"] | None = None,
    ) -> None:
        """Fuse one cloud per environment into its map.

        Args:
            points: sensor-frame points [m]; NaN or inf points are ignored, so pad ragged clouds with NaN.
            T_map_sensor: takes sensor-frame points into the map frame; float64 far from the origin.
            T_map_base: the robot; the window follows it. None: the window stays, overlap and body box are skipped.
            dt: time since that environment's last update [s], required; 0.0 for a further sensor of the same instant.
                Visibility clean-up and ageing need it.
            variance: of each point's height [m^2], in place of the noise model; a point whose variance is not positive
                and finite is ignored.

        Raises ValueError or TypeError before anything changed; TypeError without dt.
        """
        inputs = self._check_inputs(points, T_map_sensor, T_map_base, dt, variance)
        self._recent.add(*inputs)
        if self.device.type == "cpu":
            keep_freed_memory()
        run = compiled_update if self._compiled else update_in_place
        weights = None if self.head is None else self.head.weights.detached()
        run = functools.partial(run, cfg=self._stages, weights=weights)
        self._filtered.clear()
        # A seventh less time than under `no_grad`: no bookkeeping for views. The state's tensors stay normal ones.
        with torch.inference_mode():
            chunks = self._chunks()
            if len(chunks) == 1:
                return run(self.state, *inputs)
            for envs in chunks:
                state = map_layers(lambda layer, envs=envs: layer[envs], self.state)
                values: list[Any] = [None if value is None else value[envs] for value in inputs]
                run(state, *values)

    def _chunks(self) -> list[slice]:
        """Divide the environments into parts of equal size, up to rounding."""
        cached = max(1, CPU_CELLS // self.cfg.grid.num_cells) if self.device.type == "cpu" else self.num_envs
        most = self.chunk or cached
        parts = math.ceil(self.num_envs / most)
        size = math.ceil(self.num_envs / parts)
        return [slice(first, first + size) for first in range(0, self.num_envs, size)]

    @overload
    def measure(
        self,
        points: Tensor,
        T_map_sensor: Tensor,
        T_map_base: Tensor | None,
        dt: float | Tensor,
        *,
        variance: Tensor | None = None,
    ) -> Measurement: ...
    @overload
    def measure(
        self, points: Tensor, T_map_sensor: Tensor, *, dt: float | Tensor, variance: Tensor | None = None
    ) -> Measurement: ...
    def measure(
        self,
        points: Float[Tensor, "B *S N 3"],
        T_map_sensor: Float[Tensor, "B *S 4 4"],
        T_map_base: Float[Tensor, "B 4 4"] | None = None,
        dt: float | Float[Tensor, "B"] | None = None,
        *,
        variance: Float[Tensor, "B *S N"] | None = None,
    ) -> Measurement:
        """Turn points into a measurement; with `forward` this is the differentiable core of `update`."""
        inputs = self._check_inputs(points, T_map_sensor, T_map_base, dt, variance)
        return measure(*inputs, self.cfg.grid, self.cfg.sensor, self.elevation.dtype)

    def forward(self, state: MapState, measurement: Measurement) -> MapState:
        """Fuse a measurement into a state and return the new one; touches no buffer (paper, Fig. 2).

        The returned tensors share no memory with the arguments. Differentiable in both by reverse mode, also under
        `torch.func.grad`, `vjp` and `jacrev`. Raises NotImplementedError under `torch.func.jvp` and `vmap`.
        """
        checks.require_full_precision(state.elevation.dtype)
        require_reverse_mode((*state[:-1], *state.statistics, *measurement, *(self._weights or ())))
        new = pipeline.forward(state, measurement, self.cfg, self._weights)
        # What no stage changed is still the caller's tensor, which an update or a reset may overwrite.
        given = (*state[:-1], *state.statistics, *measurement)
        # Not by `id`, on whose values the compiler would make its graphs depend.
        return map_layers(lambda value: value.clone() if any(value is other for other in given) else value, new)

    @property
    def _weights(self) -> Weights | None:
        return None if self.head is None else self.head.weights

    def _check_inputs(
        self, points: Any, T_map_sensor: Any, T_map_base: Any, dt: Any, variance: Any
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor, Tensor | None]:
        B, device, always = self.num_envs, self.device, self.check_values
        checks.require_full_precision(self.elevation.dtype)
        require_reverse_mode((points, T_map_sensor, T_map_base, dt, variance))
        cloud = checks.check_points(points, B, device)
        S = cloud.shape[1]
        shape = (B, S, 4, 4) if points.ndim == 4 else (B, 4, 4)
        T_map_sensor = checks.check_pose("T_map_sensor", T_map_sensor, shape, device, always).view(B, S, 4, 4)
        if T_map_base is not None:
            T_map_base = checks.check_pose("T_map_base", T_map_base, (B, 4, 4), device, always)
        dt = checks.check_dt(dt, B, device, self.elevation.dtype, always)
        if variance is not None:
            variance = checks.check_tensor("variance", variance, device, checks.FLOATS)
            fits = variance.shape == points.shape[:-1]
            require(fits, "variance", f"expected {tuple(points.shape[:-1])}", tuple(variance.shape), "one per point")
            variance = variance.view(cloud.shape[:-1])
        return cloud, T_map_sensor, T_map_base, dt, variance

    def compile(self) -> None:  # type: ignore[override]
        """Make `update` run compiled. The first update compiles for about a minute, which needs a C++ compiler.

        Maps of equal configs share the graphs, and so do scans of any length. Another number of sensors, or a base pose
        that comes or goes, makes others. So do, of environments, one alone, the first number, and the next, whose
        graphs are for all. An update is three graphs, each of which writes its part of the new state: if it is stopped,
        by Ctrl-C or for want of memory, the window may have moved without the scan's points being taken in, or those
        without its rays. Such a map is sound; go on with the next scan. Raises RuntimeError before torch 2.10, whose
        compiler cannot.
        """
        new, hint = torch.__version__ >= "2.10", "upgrade it, or leave updates uncompiled"
        require(new, "torch", "must be 2.10 or later to compile updates", torch.__version__, hint, RuntimeError)
        self._compiled = True

    def warm_up(
        self,
        num_points: int,
        num_sensors: int = 1,
        *,
        base: bool = True,
        variance: bool = False,
        dtype: torch.dtype = torch.float32,
        pose_dtype: torch.dtype = torch.float64,
    ) -> None:
        """Compile the updates that follow without touching the map, its statistics or what its filters keep.

        Call it after `compile`, with what `update` will be given; else that compiles in its turn. A map that is not
        compiled has nothing to warm up: the arguments are checked, and nothing is done.

        Args:
            num_points: N of each sensor; updates of other numbers from 2 on share the graphs.
            num_sensors: S.
            base: whether updates come with `T_map_base`.
            variance: whether they come with `variance`.
            dtype: of the points, and of their variance.
            pose_dtype: of `T_map_sensor` and `T_map_base`.

        Raises ValueError or TypeError for arguments that no update takes.
        """
        N = require_count("num_points", num_points, "give the number of points of each sensor")
        S = require_count("num_sensors", num_sensors, "give the number of sensors")
        B, device = self.num_envs, self.device
        with torch.inference_mode(False), torch.no_grad():
            points = torch.full((1, 1, 1, 1), torch.nan, dtype=dtype, device=device).expand(B, S, N, 3)
            T = torch.eye(4, dtype=pose_dtype, device=device).expand(B, S, 4, 4)
            variances = torch.ones((1, 1, 1), dtype=dtype, device=device).expand(B, S, N) if variance else None
            inputs = self._check_inputs(points, T, T[:, 0] if base else None, 0.0, variances)
        if self._compiled:
            ends = [chunk.indices(B)[:2] for chunk in self._chunks()]
            sizes = dict.fromkeys(end - start for start, end in ends)  # the last chunk may be smaller
            weights = None if self.head is None else self.head.weights.detached()
            compile_ahead(inputs, sizes, self.elevation.dtype, self._stages, weights)

    def extra_repr(self) -> str:
        """Say how many maps there are, and how large."""
        grid = self.cfg.grid
        size = f"{grid.length_x:g} x {grid.length_y:g} m, resolution={grid.resolution:g} m"
        return f"num_envs={self.num_envs}, {size}, device={self.device}"

    def reset(self, env_ids: Int[Tensor, "K"] | None = None, *, mask: Bool[Tensor, "B"] | None = None) -> None:
        """Forget everything in some environments: all, those of `env_ids`, or those of `mask` (no host sync)."""
        require(env_ids is None or mask is None, "env_ids, mask", "exclude each other", "both", "give one of them")
        if mask is not None:
            mask = checks.check_tensor("mask", mask, self.device, (torch.bool,))
            fits = tuple(mask.shape) == (self.num_envs,)
            require(fits, "mask", f"expected ({self.num_envs},)", tuple(mask.shape), "give one bool per environment")
        if env_ids is not None:
            env_ids = checks.check_env_ids(env_ids, self.num_envs, self.device, self.check_values)
        self._filtered.clear()
        self._recent.forget(env_ids, mask)
        with torch.no_grad():
            forget(self.state, self.cfg.grid, env_ids, mask)

    def initialize(self, feet: Float[Tensor, "B K 3"], method: str = "linear") -> None:
        """Found the unknown cells on ground points such as the feet, map frame [m].

        "linear": inside the feet's convex hull; "nearest": the whole window. The variance is the maximum, so that
        the first measurement wins. Raises ValueError for another method or shape.
        """
        feet = checks.check_tensor("feet", feet, self.device, checks.FLOATS)
        fits = feet.ndim == 3 and feet.shape[0] == self.num_envs and feet.shape[1] >= 1 and feet.shape[2] == 3
        require(fits, "feet", f"expected ({self.num_envs}, K, 3) with K >= 1", tuple(feet.shape), "give ground points")
        require(method in METHODS, "method", f"must be one of {', '.join(METHODS)}", repr(method), "use linear")
        if checks.readable(feet, self.check_values):
            require(bool(torch.isfinite(feet).all()), "feet", "must be finite", "NaN or inf", "leave those feet out")
        state = initialize(self.state, feet, method, self.cfg.grid, self.cfg.fusion.max_variance)
        self._store(rate_surface(state, self.cfg, self._weights))

    # Reading --------------------------------------------------------------------------------------------------------

    @property
    def center(self) -> Float[Tensor, "B 3"]:
        """The windows' centres [m], map frame, float64; z is the base's last height."""
        xy = window_center(self.corner, self.cfg.grid)
        return torch.cat([xy, self.base_height.double()[:, None]], -1)

    def diagnose(self) -> list[str]:
        """Return sentences on what looks wrong, worst first: what was seen, the likely cause, and what to do.

        Empty when all is well, or when nothing tells. It looks at a few of the updates since the last `reset`, of the
        first environments, and waits for the device; nothing else does. For it a map keeps copies of some of the last
        inputs, thinned to 3,000 points. Updates inside a `torch.compile` of your own are not looked at.
        """
        return diagnose(self.cfg, self.state, self._recent)

    def cell_centers(self) -> Float[Tensor, "B H W 2"]:
        """Return the cell centres [m], map frame, float64."""
        return cell_centers(self.corner, self.cfg.grid)

    def layer(self, name: str, *, state: MapState | None = None) -> Float[Tensor, "B H W"]:
        """Return a fresh tensor of one layer, NaN where unknown: one of the map's, or of the configured filters'.

        elevation, upper_bound [m]; variance [m^2]; time [s] since the last hit; traversability, 0 to 1, the better;
        normal_x, normal_y, normal_z of unit length; validity, 1 where the elevation is known, else 0. The upper bound
        equals the elevation where that is known; elsewhere the ground lies no higher, as rays passed above it. Normals
        and the analytic traversability are unknown, too, where the known cells around do not span a plane. A filter
        runs when its layer is read, with those it needs, and again only after something was stored.
        Raises KeyError for an unknown name.
        """
        values, known = self._read(name, state)
        return torch.where(known, values, torch.nan)

    @property
    def layers(self) -> tuple[str, ...]:
        """The names of all layers: the map's, then those of the configured filters."""
        return (*LAYERS, *self.filters.inputs)

    def _read(self, name: str, state: MapState | None) -> Layer:
        if name in self.filters:
            return self._filter(name, state)
        hint = f"there are {', '.join(self.layers)}"
        require(name in LAYERS, "layer", "must be a layer's name", repr(name), hint, KeyError)
        return LAYERS[name](self.state if state is None else state)

    def _filter(self, name: str, state: MapState | None) -> Layer:
        if state is not None:
            return self.filters.read(name, lambda source: self._read(source, state), {})
        with torch.inference_mode(False), torch.no_grad():  # kept, and perhaps read outside of inference mode later
            return self.filters.read(name, lambda source: self._read(source, None), self._filtered)

    def rate(self, *, state: MapState | None = None) -> Rating:
        """Return traversability and confidence of every cell, (B, H, W) each, 0 to 1.

        The learned head rates unknown cells too. Its confidence is the probability that "traversability is at least one
        half" is right, of ground such as it was trained on: far from all that is known both are that ground's average.
        `layer("validity")` tells what is known. The analytic head gives 0 to cells that it cannot rate, confidence 1 to
        others.
        Differentiable in the state and in the weights of `head`. Raises ValueError if traversability is switched off.
        """
        state, cfg = self.state if state is None else state, self.cfg.traversability
        require(cfg is not None, "cfg.traversability", "must not be None", None, "give a TraversabilityConfig")
        if isinstance(cfg, LearnedTraversabilityConfig) and self.head is not None:
            return learned_rating(state, self.cfg.grid, cfg, self.head.weights)
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
        """Read a layer at points (B, M, 2) [m], map frame. Returns values (B, M), 0 where not valid, and valid (B, M).

        "bilinear" renormalises over known neighbours and is valid when their weight is at least one half; "nearest"
        reads the cell that holds the point. Differentiable in the state and, if bilinear, in `xy`.

        Raises KeyError for an unknown layer, ValueError for another mode or shape.
        """
        xy = checks.check_xy("xy", xy, self.num_envs, self.device)
        good = mode in ("bilinear", "nearest")
        require(good, "mode", 'must be "bilinear" or "nearest"', repr(mode), "use bilinear")
        corner = (self.state if state is None else state).corner
        uv = (xy.double() / self.cfg.grid.resolution - corner[:, None]).to(self.elevation.dtype)
        return sample_layer(self._read(layer, state), uv, self.cfg.grid, mode)
