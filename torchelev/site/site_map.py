"""`SiteMap`: the class that users call."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.maps.centering import center_on
from torchelev.ops.masks import count
from torchelev.ops.storage import keep_freed_memory
from torchelev.site import contributions
from torchelev.site.areas import require_resolution
from torchelev.site.content.channels import SiteChannels
from torchelev.site.content.levels import SiteLevels
from torchelev.site.content.tiles import LAYERS, locate
from torchelev.site.fill_levels import fill_levels
from torchelev.site.fusion.align import align
from torchelev.site.fusion.fuse_levels import read_surfaces
from torchelev.site.fusion.merge import MergeReport, merge_windows
from torchelev.site.fusion.shares import Change, read_changes
from torchelev.site.fusion.stacks import Change as SurfaceChange
from torchelev.site.fusion.windows import (
    Alignment,
    Windows,
    no_alignment,
    no_contribution,
    read_known,
    read_windows,
    snapshot,
)
from torchelev.site.initialize_from_site import fill_windows, spread
from torchelev.site.keyframed_site import KeyframedSite, require_poses
from torchelev.site.keyframes.keyframe_log import KeyframeLog, arrays_of
from torchelev.site.keyframes.keyframes import Recorded
from torchelev.site.keyframes.rebuild import merge_recorded
from torchelev.site.rasters.raster_site import RasterSite
from torchelev.site.shared.collective import open_shared
from torchelev.site.shared.ranks import Ranks
from torchelev.site.shared.shared_merge import gather_tiles, merge_shared
from torchelev.site.site_config import SiteConfig
from torchelev.site.storage.interface import Note
from torchelev.site.storage.versioned.repository import UncertainCommitError
from torchelev.site.times import check_time, continue_time, warn_of_other_clock
from torchelev.stages.initialize import Remembered
from torchelev.state import MapState, map_layers

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch.distributed import ProcessGroup

    from torchelev.levels.config import LevelsConfig
    from torchelev.site.storage.engines import Engine

_FREED_BYTES = 96  # of a cell, which a merge takes and frees: faulting them in again takes a tenth of its time


class SiteMap(KeyframedSite, RasterSite):
    """A world map that grows: the windows of many robots, in one frame.

    ```python
    site = SiteMap(resolution=0.1, path="site")              # a folder; None: in memory
    while exploring:
        emap.update(points, T_map_sensor, T_map_base, dt)    # B robots
        report = site.merge(emap)                            # every second or so
    values, valid = site.sample(xy)
    ```

    It is made of square tiles; a merge touches only those below the windows. On disk, a merge is written
    completely or not at all, and memory does not grow with the area. Each merge makes a version: see `versions`, `tag`,
    `rollback` and `compact`. Several processes may write to one site: those of a folder take turns; in an object store,
    the later one of two that meet merges on top of the earlier one.

    With a `group`, all its ranks hold one site, and `merge` takes the robots of all of them, in the order of the ranks:
    call it on all ranks, which wait for each other and share the work. Each rank reads by itself. On disk, all ranks
    write to one folder, which all must see, and rank 0 commits. See `torchelev.site.shared.collective`.

    Args:
        resolution: [m] of the cells, as of the maps that are merged.
        path: the folder or object store, s3://bucket/prefix, to keep it in, which needs ``torchelev[site]``. A site
            that is there already is continued. None: in memory, 28 bytes for each cell of a tile. What S3 needs to know
            comes from the environment: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION, AWS_ENDPOINT_URL.
        cfg: how windows are aligned and fused.
        device: that fuses; maps may lie on another one.
        group: processes that share the site, such as `torch.distributed.group.WORLD`; None: this one alone. Give
            `init_process_group` a `timeout` that is longer than ranks wait for each other, such as a minute: after it,
            those that wait for a rank that has died raise `LostRankError`.
        keyframes: keep the contributions of each merge, so that `move_keyframes` can correct poses later: 32 bytes for
            each cell of the windows and merge, less what compression saves on disk. Holds from the first merge on; a
            site on disk that has keyframes continues to keep them.
        channels: keep these channels of the maps that are merged, as of `ElevationMapConfig(channels=...)`: 4 bytes for
            each cell and component, and 8 for the weight and since when it counts ("maximum": 4). Settings of ageing
            are of no use. Holds from the first merge on; a site on disk that has channels continues to keep them.
        engine: of a new site: "icechunk" keeps versions and takes several writers; "files" neither, but needs a 45th of
            the space after a hundred merges, and reads four times as fast. None: "icechunk" where it is installed, as
            with ``torchelev[site]`` on Python 3.11 and later, and "files" otherwise.

    Attributes:
        resolution: [m].
        cfg: settings.

    Raises:
        ValueError: the resolution is not positive or not that of the site at `path`, or there is something else; the
            group is not initialised, or its ranks open the site differently; or `keyframes` are to be kept by a group,
            or by a site that was begun without; or `channels` or `levels` are to be kept beside keyframes or by a
            group, or are others than those of the site at `path`.
        OSError: the folder or object store cannot be reached or written.
        ModuleNotFoundError: the engine is missing.
    """

    def __init__(
        self,
        resolution: float = 0.1,
        path: str | Path | None = None,
        *,
        cfg: SiteConfig | None = None,
        device: torch.device | str = "cpu",
        group: ProcessGroup | None = None,
        keyframes: bool = False,
        channels: Mapping[str, Any] | None = None,
        levels: LevelsConfig | None = None,
        engine: Engine | None = None,
    ) -> None:
        self._ranks, wanted = Ranks(group), (SiteChannels(channels, LAYERS), SiteLevels(levels))
        wanted[1].require_alone(self._ranks.size == 1 and not keyframes)
        self._ranks.exchange("SiteMap", lambda: {"same": self._set_up(resolution, path, cfg)})
        self._store = (
            None if path is None else open_shared(self._ranks, "SiteMap", path, self.resolution, *wanted, engine)
        )
        self._keyframes = KeyframeLog(self._store) if keyframes else None
        with self._closed_on_failure():
            self._begin(device, *wanted)
        self._check_kept(keyframes, *wanted)
        self._agree_on_id()

    # Merging --------------------------------------------------------------------------------------------------------

    @torch.inference_mode(False)  # whose tensors could not be written outside of it
    @torch.no_grad()
    def merge(
        self,
        emap: ElevationMap,
        *,
        time: float | None = None,
        align: bool = True,
        tilt: bool = False,
        T_map_base: Float[Tensor, "B 4 4"] | None = None,
    ) -> MergeReport:
        """Fuse what B robots have measured since their last merge.

        First, the robots' heights are aligned with each other and with the site, as each has its own drift. Then their
        cells are fused by their variances; a robot's earlier share of a cell is replaced, so that nothing counts twice.
        Heights that contradict each other are kept apart: the site shows the newer one once it is about as sure, and
        the layers `other_elevation`, `other_variance` and `other_time` hold the one that it contradicts. Channels that
        the site keeps are those of its elevation: means by weight, counts of classes added up, the largest of maxima,
        and of "exponential" and "class_average" what was measured last. Maps may lack channels that the site keeps.
        A site with levels takes all surfaces of maps with levels, and the ground of others; the lowest surface of each
        cell is its ground. The site's `min_gap` separates surfaces, whatever that of the maps.

        Args:
            emap: the map, of the site's resolution. The site recognises it, not copies of it.
            time: [s] now, on any clock that all merges share, such as `time.time()`. A time before the site's newest
                one, or more than a year after it, counts as it is, with a RuntimeWarning. None: the site's time
                advances by the map's elapsed time since its last merge.
            align: find the robots' offsets; otherwise their heights count as they are.
            tilt: also find how their windows tilt, in roll and pitch.
            T_map_base: the robots' poses, as they were given to `ElevationMap.update`. Required if keyframes are kept,
                of no use otherwise.

        Returns:
            Offsets and counts, per robot.

        Raises:
            TypeError: `emap` is not an ElevationMap, or `time` is not a number.
            ValueError: `emap` has another resolution or a channel of another kind, `time` is not in seconds, or the
                site is read-only or closed. Nothing has changed then.
            OSError: the disk is full; the site is as it was before.
            LostRankError: of a group, another rank has ended; the site is as it was before.
        """
        return self._in_turn(partial(self._merge, emap, time, align, tilt, T_map_base))

    def _merge(
        self, emap: ElevationMap, time: float | None, align: bool, tilt: bool, T_map_base: Tensor | None
    ) -> MergeReport:
        """Merge into the version that the site shows; Overtaken if it is no longer the newest one."""
        plans = self._ranks.exchange("merge", lambda: self._plan(emap, time, align, tilt))
        if self._keyframes is not None:
            T_map_base = require_poses(emap, T_map_base)
        if emap.device.type == "cpu":
            keep_freed_memory(_FREED_BYTES * emap.elevation.numel())
        contribution = contributions.recall(emap, self._id)
        if self._rate is None:
            self._rate = plans[0]["rate"]
        now = max(plan["now"] for plan in plans)  # of all ranks
        now = now if time is None else self._since_epoch(now)
        state = self._bring(emap)
        windows = read_windows(emap, state, now, contribution)
        self._exchange.split(windows.known.corner, windows.is_new.shape[1:])
        alignment = self._align(windows, align, tilt)
        new = self._record(windows, alignment, T_map_base, now)
        keyframes = torch.full_like(state.elapsed, -1) if new is None else new.ids
        number = self._num_commits + 1
        changes = read_changes(emap, windows, alignment, self._tiles.channels, self.resolution, number)
        shares = {name: change.now for name, change in changes.items()}
        surfaces, levels = None, self._tiles.levels.cfg
        if levels is not None:  # without a group
            windows, surfaces = read_surfaces(emap, state, windows, self.resolution, levels.min_gap)
        stack = None if surfaces is None else surfaces.now
        contribution = snapshot(emap, windows, alignment, state.elapsed, keyframes, shares, stack)
        if self._store is None and new is None:  # interrupted, memory may hold a part, which must not count twice
            self._keep(emap, contribution)
        robots, new_cells = [plan["robots"] for plan in plans], count(windows.is_new)
        try:
            note = describe_merge(sum(robots), int(self._exchange.sum(new_cells.sum())))
            contradictions = self._fuse(windows, alignment, robots, now, new, changes, surfaces, note)
        except UncertainCommitError as error:
            self._in_doubt = error.commit, emap, contribution
            raise
        self._keep(emap, contribution)
        return MergeReport(*alignment, new_cells, contradictions)

    def _bring(self, emap: ElevationMap) -> MapState:
        """Return a map's state on the site's device."""
        device, state = self._tiles.device, emap.state
        return state if emap.device == device else map_layers(lambda value: value.to(device), state)

    def _plan(self, emap: ElevationMap, time: float | None, align: bool, tilt: bool) -> dict[str, Any]:
        """Return what this rank is about to merge; raise if it cannot."""
        self._check_merge(emap)
        time, contribution = check_time(time), contributions.recall(emap, self._id)
        elapsed = emap.state.elapsed.to(self._tiles.device)
        now = continue_time(elapsed, contribution, self._time, self._opened) if time is None else time
        merged = {"tiles": len(self), "time of the site": self.time}
        time_is = "not given" if time is None else "given"
        options = {"time": time_is, "align": bool(align), "tilt": bool(tilt)}
        grid = emap.cfg.grid
        same = {"size of the window": [grid.height, grid.width], **options, **merged}
        rate = emap.cfg.aging.variance_rate
        return {
            "same": same,
            "robots": emap.num_envs,
            "now": now,
            "rate": rate,
        }

    def _check_merge(self, emap: ElevationMap) -> None:
        actual, hint = type(emap).__name__, "give an ElevationMap"
        require(isinstance(emap, ElevationMap), "emap", "must be an ElevationMap", actual, hint, TypeError)
        self.require_resolution(emap)
        self._tiles.channels.require_fit(emap)
        self._require_writable()
        rule, hint = "must be opened again by all ranks, with maps that are reset", "the last commit may be stored"
        require(not self._is_broken, "site", rule, "a group after a lost connection", hint)
        self._require_not_taken_back(emap, contributions.find(emap, self._id))

    def require_resolution(self, emap: ElevationMap) -> None:
        """Raise ValueError unless a map has the site's resolution."""
        require_resolution(emap.cfg.grid.resolution, self.resolution)

    def _since_epoch(self, time: float) -> float:
        """Return a time that was given, from the epoch. The first one becomes the epoch."""
        if self._has_clock:
            warn_of_other_clock(time, self.time)
        return self._count_from_epoch(time)

    def _align(self, windows: Windows, with_offsets: bool, with_tilt: bool) -> Alignment:
        if not with_offsets:
            return no_alignment(len(windows.known.corner), self._tiles.device)
        gap = self._tiles.levels.max_difference
        return align(windows, self._read_cells, self.resolution, self.cfg, with_tilt, gap, self._exchange)

    def _read_cells(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the site's elevation and variance at cells of the lattice, NaN where unknown."""
        elevation, variance, time = self._tiles.look_up(locate(x, y), ("elevation", "variance", "time"))
        return elevation, variance + self._clock.rate * (self._time - time)

    def _fuse(
        self,
        windows: Windows,
        alignment: Alignment,
        robots: list[int],
        now: float,
        new: Recorded | None,
        changes: dict[str, Change],
        surfaces: SurfaceChange | None,
        note: Note,
    ) -> Int[Tensor, "B"]:
        """Fuse windows, or their keyframes, into tiles; return each robot's contradictions. `robots`: of each rank."""
        rate, time, exchange = self._clock.rate, max(self._time, now), self._exchange
        if exchange.size > 1:
            first, number = sum(robots[: exchange.rank]), sum(robots)
            scale = self.resolution, rate, self.cfg
            own = merge_shared(self._tiles, windows, alignment, first, number, *scale, exchange)
            every = own if self._store else gather_tiles(own, exchange)
            contradictions = exchange.sum(self._write(every, time, number, note=note))
            return contradictions[first : first + robots[exchange.rank]]
        if self._keyframes is None or new is None:
            parts = merge_windows(self._tiles, windows, alignment, self.resolution, rate, self.cfg, changes, surfaces)
            return self._write(parts, time, len(windows.known.corner), note=note)
        parts = merge_recorded(self._tiles, self._keyframes.rows, new, self.resolution, rate, self.cfg)
        contradictions = self._write(parts if self._store else list(parts), time, len(new.ids), arrays_of(new), 1, note)
        self._keyframes.append(new)
        return contradictions

    @torch.inference_mode(False)  # whose tensors could not be written outside of it
    @torch.no_grad()
    def fill_state(self, emap: ElevationMap, T_map_base: Tensor | None, chosen: Bool[Tensor, "B"]) -> MapState:
        """Return a map's state with what the site knows filled in; `ElevationMap.initialize_from` calls it."""
        self.require_resolution(emap)
        self._settle()
        contribution, state = contributions.recall(emap, self._id), self._bring(emap)
        number = None if contribution is None else contribution.number
        device, chosen = self._tiles.device, chosen.to(self._tiles.device)
        if T_map_base is not None:
            state = center_on(state, emap, T_map_base.to(device), chosen)
        if contribution is None:
            contribution = no_contribution(read_known(emap, state, self._time), emap.num_resets.to(device))
        known = self._read_chosen(state, chosen)
        after, filled = fill_windows(state, emap, known, contribution, chosen, self._clock, self.resolution)
        if self._tiles.levels:
            filled = fill_levels(emap, state, after, self._tiles, filled, chosen, self._clock, self.resolution)
        self._keep(emap, filled, number)
        return map_layers(lambda value: value.to(emap.device), after)

    def _read_chosen(self, state: MapState, chosen: Bool[Tensor, "B"]) -> Remembered:
        """Return what the site knows of the windows of the chosen environments, NaN of others."""
        ids, size = chosen.nonzero()[:, 0], state.elevation.shape[1:]
        areas = self.windows(state.corner[ids], size[0], size[1], Remembered._fields) if len(ids) else {}
        return spread(areas, ids, state.elevation)


def describe_merge(num_robots: int, num_cells: int) -> Note:
    """Return what the history says of a merge."""
    robots = f"{num_robots} robot{'s' * (num_robots != 1)}"
    return Note(f"{robots}, {num_cells:,} new cells", num_robots, num_cells)
