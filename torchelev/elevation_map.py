"""`ElevationMap`: the module that users call.

It holds state and config, and does no mathematics. `MapBuffers` stores the maps and `ReadableMap` reads them; the
methods here check their arguments and run the stages.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, overload

import torch
from torch import Tensor

from torchelev import pipeline
from torchelev.channels.config import ChannelConfigs
from torchelev.channels.inputs import check_features
from torchelev.channels.views import build_libraries
from torchelev.config import ElevationMapConfig
from torchelev.diagnosis.forks import survive_forks
from torchelev.diagnosis.history import InputHistory
from torchelev.diagnosis.update_times import UpdateTimes, timed
from torchelev.errors import require, require_count
from torchelev.inputs import checks
from torchelev.inputs.chunks import make_chunks, run_in_chunks
from torchelev.inputs.update_inputs import (
    Inputs,
    check_inputs,
    placeholder_inputs,
    require_full_precision,
    requires_dt,
    takes_features,
)
from torchelev.kernels.choose import Backend, choose
from torchelev.levels.compiled import StoredLevels
from torchelev.levels.functional import forward as update_with_levels
from torchelev.levels.functional import require_levels
from torchelev.levels.state import Levels
from torchelev.maps.buffers import without_shared_memory
from torchelev.maps.restarts import RestartableMap
from torchelev.ops.storage import keep_freed_memory
from torchelev.ops.transforms import is_readable, require_reverse_mode
from torchelev.pipeline import update_by_tensors, update_in_place
from torchelev.stages.measure.stage import find_own, measure, time_step
from torchelev.state import MapState, Measurement, map_layers

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jaxtyping import Bool, Float

    from torchelev.traversability.net import TraversabilityNet
    from torchelev.traversability.weight_file import Weights
    from torchelev.viz.live import LiveView


class ElevationMap(RestartableMap):
    """B robot-centric elevation maps on one device.

    Args:
        cfg: configuration of all stages; None: the defaults.
        num_envs: number of maps, B.
        device: device of the maps; `emap.to(device)` moves them.
        check_values: also check the values of poses, tensor `dt` and ids that lie on another device than the CPU, for
            which the host waits. Without, an environment whose pose is not finite ignores its points and keeps its
            window, and a `dt` that is negative or not finite counts as 0.
        chunk: update at most this many environments at a time, to save memory; results agree up to rounding. None: all
            on a GPU, and on a CPU as many as are fastest. C++ updates one map at a time whatever this is.
        head: trained traversability head, used as it is and not copied, in place of the weights that `cfg` names.

    Raises:
        TypeError: if `cfg` is no ElevationMapConfig.
        ValueError: if a number is out of range, or the head does not suit the robot or the resolution.
    """

    num_resets: Tensor

    def __init__(
        self,
        cfg: ElevationMapConfig | None = None,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        check_values: bool = False,
        chunk: int | None = None,
        head: TraversabilityNet | None = None,
    ) -> None:
        cfg = checks.given_or_default(ElevationMapConfig, cfg)
        num_envs = require_count("num_envs", num_envs, "give the number of maps")
        survive_forks()
        super().__init__(cfg, num_envs, device, head)
        self.check_values = check_values
        self.chunk = None if chunk is None else require_count("chunk", chunk, "give a number of environments, or None")
        self.update_times = UpdateTimes()
        self._links = cfg.sensor.links
        # Compiled stages are shared by maps of equal ones.
        self._update_cfg = dataclasses.replace(cfg, filters=(), channels=ChannelConfigs())
        self._only_by_tensors = pipeline.only_by_tensors(cfg)
        self._key = pipeline.register_stages(self._update_cfg)
        self._history = InputHistory()
        with torch.inference_mode(False):
            #: (B,) how often each environment was reset: what it told a site before does not count as its own
            self.register_buffer("num_resets", self.corner.new_zeros(self.num_envs), persistent=False)
        self._num_bytes = sum(buffer.nbytes for buffer in self.buffers())

    # Updating -------------------------------------------------------------------------------------------------------

    @takes_features
    @timed
    def update(
        self,
        points: Float[Tensor, "B *S N 3"],
        T_map_sensor: Float[Tensor, "B *S 4 4"],
        T_map_base: Float[Tensor, "B 4 4"] | None = None,
        dt: float | Float[Tensor, "B"] | None = None,
        *,
        variance: Float[Tensor, "B *S N"] | None = None,
        T_base_links: Float[Tensor, "B K 4 4"] | None = None,
        pose_covariance: Float[Tensor, "B *S 6 6"] | None = None,
        moving: bool | Bool[Tensor, "B"] | None = None,
        features: Mapping[str, Float[Tensor, "B *S N C"]] | None = None,
    ) -> None:
        """Fuse one cloud per environment into its map.

        On a CPU, OpenMP's threads wait only briefly for each other while other processes want the cores, unless
        `OMP_WAIT_POLICY` or `GOMP_SPINCOUNT` is set in the environment.

        Args:
            points: sensor-frame points [m], (B, N, 3), or (B, S, N, 3) of S sensors at one instant. Points that are NaN
                or inf are ignored: pad ragged clouds with NaN.
            T_map_sensor: sensor frame to map frame, (B, 4, 4) or (B, S, 4, 4); give float64 far from the origin.
            T_map_base: pose of the robot, (B, 4, 4). The window follows it, and overlap clearance and the body box need
                it. None: the window stays, and both are skipped. Required if `cfg.sensor.body` is a `RobotBody`.
            dt: time since that environment's last update [s], a number or (B,); 0.0 for a further sensor of the same
                instant. Required: ageing and visibility clean-up depend on it.
            variance: variance of each point's height [m^2], (B, N) or (B, S, N), in place of the noise model. Points
                whose variance is not positive and finite are ignored.
            T_base_links: poses of the links in the base frame, (B, K, 4, 4), as joint encoders gave them at the time of
                the points, in the order of `cfg.sensor.body.links`. Required if the body is a `RobotBody`, and only
                then.
            pose_covariance: covariance of each sensor's pose, (B, 6, 6) or (B, S, 6, 6): x, y, z [m], then the
                rotations about the map's axes [rad], as in a ROS Odometry message. It adds J Sigma J^T to the variance
                of each point's height, J = (0, 0, 1, r_y, -r_x, 0) with r from the sensor to the point; the layer
                `variance` then holds what the pose's errors add. None: poses are exact.
            moving: whether the robot moves, a bool or (B,): the height of one that stands does not drift, and is not
                corrected. None: all move.
            features: what each point brings for the channels of the config, by name: (B, N, C) or (B, S, N, C), NaN
                where a point brings nothing. Colours are from 0 to 1, or uint8; probabilities of classes sum to 1.

        Raises:
            TypeError: if `dt` is missing, or an argument has the wrong type or dtype. Nothing has changed then.
            ValueError: if a shape, device or value is wrong. Nothing has changed then.
            KeyError: if `features` names a channel that is not there. Nothing has changed then.
        """
        given = (points, T_map_sensor, T_map_base, dt, variance, T_base_links, pose_covariance, moving)
        inputs = self._check_inputs(*given)
        brought = check_features(features, points, self.cfg.channels, self.device)
        state = self.state
        self._history.add(inputs, state.statistics.drift_correction)
        self._derived.clear()
        if is_readable(self.elevation):
            keep_freed_memory(self._num_bytes)
        weights = None if self._weights is None else self._weights.detached()
        # A seventh faster than `no_grad`, as views need no bookkeeping; the buffers stay normal tensors.
        with torch.inference_mode():
            self._run_stages(state, inputs, weights)
        if self.channels is not None:
            own = find_own(inputs, self.cfg.sensor) if brought else None
            self.channels.update(self.state, time_step(inputs.dt, torch.float32), inputs, own, brought)

    def _run_stages(self, state: MapState, inputs: Inputs, weights: Weights | None) -> None:
        """Update these maps by the backend that suits them."""
        name, levels = self.backend.name, self.levels
        if levels is None:
            self._run_backend(name, state, inputs, weights)
        elif name == "CPU":
            self._run_backend(name, state, inputs, weights, levels.compiled)
        else:
            self._run_backend(name, state, levels.sort_points(state, inputs), weights)
            levels.follow_drift(state)

    def _run_backend(
        self, name: str, state: MapState, inputs: Inputs, weights: Weights | None, levels: StoredLevels | None = None
    ) -> None:
        """Update a state, and levels where C++ does so, by a backend."""
        run = functools.partial(update_by_tensors, cfg=self._update_cfg, weights=weights)
        if name != "TORCH":
            run = functools.partial(update_in_place, cfg=self._update_cfg, weights=weights, key=self._key)
        # Chunks would save no memory in C++, which keeps one map's for each thread.
        chunks = [slice(None)] if name == "CPU" and weights is None else self.chunks
        run_in_chunks(run, state, inputs, chunks, levels)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy or an unpickled map, whose process may know its config by another key."""
        super().__setstate__(state)
        self._key = pipeline.register_stages(self._update_cfg)

    @requires_dt
    def measure(
        self,
        points: Float[Tensor, "B *S N 3"],
        T_map_sensor: Float[Tensor, "B *S 4 4"],
        T_map_base: Float[Tensor, "B 4 4"] | None = None,
        dt: float | Float[Tensor, "B"] | None = None,
        *,
        variance: Float[Tensor, "B *S N"] | None = None,
        T_base_links: Float[Tensor, "B K 4 4"] | None = None,
        pose_covariance: Float[Tensor, "B *S 6 6"] | None = None,
        moving: bool | Bool[Tensor, "B"] | None = None,
    ) -> Measurement:
        """Return the measurement of a cloud, for `forward`. Arguments and errors are those of `update`."""
        given = (points, T_map_sensor, T_map_base, dt, variance, T_base_links, pose_covariance, moving)
        inputs = self._check_inputs(*given)
        return measure(*inputs, self.cfg.grid, self.cfg.sensor, self.elevation.dtype)

    @overload
    def forward(self, state: MapState, measurement: Measurement) -> MapState: ...

    @overload
    def forward(self, state: MapState, measurement: Measurement, levels: Levels) -> tuple[MapState, Levels]: ...

    def forward(
        self, state: MapState, measurement: Measurement, levels: Levels | None = None
    ) -> MapState | tuple[MapState, Levels]:
        """Return the state with a measurement fused into it (paper, Fig. 2), without touching the buffers.

        Differentiable in all arguments by reverse mode, also under `torch.func.grad`, `vjp` and `jacrev`.

        Args:
            state: state to start from, such as `emap.state`.
            measurement: what `measure` returned.
            levels: the other surfaces of a map with levels, `emap.levels.in_windows(state)` or what the last call
                returned. None: the map's own sort the points, and what becomes of them is not returned.

        Returns:
            The new state, or the new state and levels if these are given. They share no memory with the arguments.

        Raises:
            NotImplementedError: under `torch.func.jvp` and `torch.func.vmap`.
            TypeError: if the state is of half precision, or the measurement of another dtype than the state.
            ValueError: if the levels are not those of the state.
        """
        dtype, other = state.elevation.dtype, measurement.points.dtype
        require_full_precision(dtype)
        hint = "measure with a map of that dtype"
        require(other == dtype, "measurement", f"must be of the state's dtype, {dtype}", other, hint, TypeError)
        require_reverse_mode((*state[:-1], *state.statistics, *measurement, *(levels or ()), *(self._weights or ())))
        new, surfaces = self._fuse(state, measurement, levels)
        new = without_shared_memory(new, (*state[:-1], *state.statistics, *measurement))
        return new if levels is None or surfaces is None else (new, surfaces)

    def _fuse(self, state: MapState, m: Measurement, levels: Levels | None) -> tuple[MapState, Levels | None]:
        """Return the state after the stages, and the levels of a map that has them."""
        run = functools.partial(pipeline.forward, cfg=self._update_cfg, weights=self._weights)
        if levels is not None:
            require_levels(levels, state, self.cfg)
        if self.levels is None:
            return run(state, m), None
        if levels is None:
            rule, actual = f"must be of all {self.num_envs} maps, whose levels sort the points", len(state.validity)
            require(actual == self.num_envs, "state", rule, actual, "give the levels of the state")
            levels = self.levels.in_windows(state)
        return update_with_levels(levels, state, m, self.cfg, run)

    def _check_inputs(self, *inputs: Any) -> Inputs:
        elevation = self.elevation
        of_map = (self.num_envs, elevation.device, elevation.dtype, self._links, self.check_values)
        return check_inputs(*inputs, *of_map)  # type: ignore[call-arg]

    @property
    def chunks(self) -> list[slice]:
        """The environments that an update works on at a time, one slice for each of its steps."""
        return make_chunks(self.num_envs, self.cfg.grid, self.device, self.chunk)

    # Compiling ------------------------------------------------------------------------------------------------------

    @property
    def backend(self) -> Backend:
        """What runs `update`, and why it is not a faster backend."""
        why_tensors = self._only_by_tensors or ("" if self.levels is None else self.levels.why_tensors)
        return choose(self.elevation, self._key, why_tensors)

    def compile(self) -> str:  # type: ignore[override]
        """Build what `update` runs on, so that the first one does not; return in a sentence what that is.

        Updates are compiled without it, too: the first one of a machine builds the C++, in about ten seconds.
        """
        self.warm_up(1)
        return str(self.backend)

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
        """Run an update as those to come, without touching the map, its statistics or its filtered layers.

        What it builds and allocates, the first update then finds. Call it with the sizes and dtypes that `update` will
        get.

        Args:
            num_points: N, per sensor.
            num_sensors: S.
            base: whether updates come with `T_map_base`.
            variance: whether updates come with `variance`.
            dtype: dtype of the points and of their variance.
            pose_dtype: dtype of the poses, those of the links included.

        Raises:
            TypeError: if no update takes these dtypes.
            ValueError: if a number is not positive.
        """
        N = require_count("num_points", num_points, "give the number of points of each sensor")
        S = require_count("num_sensors", num_sensors, "give the number of sensors")
        kinds: dict[str, Any] = dict(device=self.device, num_links=len(self._links), dtype=dtype, pose_dtype=pose_dtype)
        with torch.inference_mode(False), torch.no_grad():
            inputs = placeholder_inputs(self.num_envs, S, N, with_base=base, with_variance=variance, **kinds)
            inputs = self._check_inputs(*inputs[: Inputs._fields.index("aside")])
        self._update_scratch(inputs)

    def _update_scratch(self, inputs: Inputs) -> None:
        """Run an update on blank maps, as large as these."""
        weights = None if self._weights is None else self._weights.detached()
        name = self.backend.name
        with torch.inference_mode():
            levels = None
            if self.levels is not None and name == "CPU":
                levels = StoredLevels(*map(torch.zeros_like, self.levels.compiled))
            self._run_backend(name, map_layers(torch.zeros_like, self.state), inputs, weights, levels)
        if self.channels is not None and is_readable(self.elevation):
            build_libraries()

    # Diagnosis ------------------------------------------------------------------------------------------------------

    def diagnose(self) -> list[str]:
        """Describe what looks wrong with the inputs, worst first: the symptom, its likely cause, and what to do.

        Looks at a few of the updates since the last `reset`, in the first environments, of which the map keeps copies
        thinned to 3,000 points per sensor; updates inside a `torch.compile` of your own are not kept. Waits for the
        device.

        Returns:
            One sentence per finding; none if all is well, or if the inputs do not show it.
        """
        from torchelev.diagnosis.causes import diagnose  # updates do not need it

        return diagnose(self.cfg, self.state, self._history)

    # Pictures: the only imports of what draws, so that one line is enough ---------------------------------------------

    def save_png(self, path: str | Path, layers: Sequence[str] | None = None, env: int = 0) -> None:
        """Draw one environment with axes in metres of the map frame. Needs `torchelev[io]`.

        Args:
            path: of the picture to write, a .png.
            layers: names of `layers`, a panel for each; None: what `torchelev map` draws.
            env: the environment.

        Raises:
            ValueError: if there is no such environment or layer, or the path is no PNG's.
            WriteError: if the picture cannot be written.
        """
        from torchelev.viz.map_picture import save_map_picture

        save_map_picture(path, self, layers, env)

    def show(self, T_map_base: Any = None, *, block: bool | None = None, **options: Any) -> LiveView:
        """Open a page that shows the map in 3D, and print its address. Needs `torchelev[view]`.

        Args:
            T_map_base: poses of the robots (B, 4, 4), to draw them; None: no robots.
            block: wait until Ctrl-C, then close the page. None: in a script yes, in an interactive session no.
            options: of `torchelev.viz.live.LiveView`, such as `port`.

        Returns:
            The view: its `show` shows the map again after further updates, `close` ends it.
        """
        from torchelev.viz.live import open_view

        return open_view(self, T_map_base, block=block, **options)

    def _forget_derived(self) -> None:
        super()._forget_derived()
        self._history.forget()
