"""Fuse the scans of a recording into a map, with a progress bar, until they end or something stops it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from torchelev.app.interrupts import defer_interrupts
from torchelev.app.mapping.map_channels import add_channels
from torchelev.channels.config import ChannelConfig
from torchelev.io import Frame, MappingRun

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig
    from torchelev.elevation_map import ElevationMap


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Where the robot's base is, and whether the window follows it."""

    T_base_sensor: NDArray[np.float64] | None  #: takes sensor-frame points into the base frame; None: unknown
    sensor_height: float | None  #: [m] above the base, an alternative to T_base_sensor; None: unknown
    fixed: bool  #: keep the window in place
    has_base: bool = False  #: each scan comes with the pose of the base
    channels: Mapping[str, ChannelConfig] = field(default_factory=dict)  #: for what the recording brings beside heights
    levels: int | None = None  #: surfaces in each cell; None: the config's

    @property
    def knows_base(self) -> bool:
        """Whether the height of the base is known, not only the sensor's."""
        return self.has_base or self.T_base_sensor is not None or self.sensor_height is not None


def new_map(config: ElevationMapConfig, device: str, options: MapOptions) -> ElevationMap:
    """Create an empty map; without the base's height, overlap clearance is turned off because it depends on it."""
    import torch

    from torchelev.elevation_map import ElevationMap
    from torchelev.levels.config import LevelsConfig

    if config.sensor.links:
        raise ValueError("config.sensor.body: recordings hold no poses of links; give one box, lower and upper")
    if config.sensor.body is not None and options.T_base_sensor is None and not options.has_base:
        raise ValueError("config.sensor.body: the body box turns with the robot's base; give --extrinsics")
    config = add_channels(config, options.channels)
    if options.levels is not None:
        config = replace(config, levels=replace(config.levels or LevelsConfig(), max_levels=options.levels))
    if not options.knows_base:
        config = replace(config, overlap=None)
    try:
        torch.empty(1, device=device)
        return ElevationMap(config, num_envs=1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"--device {device}: {reason}; use cpu, or install a torch built for that device") from error


class Scans(Protocol):
    """Scans in their order: a folder's or a bag's. A bag yields None for a scan that has to be left out."""

    @property
    def middle(self) -> NDArray[np.float64]:
        """The middle (3,) [m] of the path, map frame."""

    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[Frame | None]: ...


def fuse_all(
    run: MappingRun,
    scans: Scans,
    options: MapOptions,
    after: Callable[[MappingRun, Frame], None] = lambda run, frame: None,
    between: Callable[[MappingRun, Frame], None] = lambda run, frame: None,
) -> BaseException | None:
    """Fuse all scans in order.

    Args:
        run: the map and its counts.
        scans: the recording.
        options: where the base is, and whether the window follows it.
        after: called after each scan, as a part of it: Ctrl-C does not stop it.
        between: called then; may wait, as Ctrl-C stops it.

    Returns:
        The exception that stopped the mapping early, so that the caller can save the map before raising it; else None.
    """
    middle = scans.middle if options.fixed else None
    try:
        for frame in show_progress(scans, "mapping", "scan"):
            if frame is None:
                continue
            if not run.num_scans:
                # This update without points also covers torch's set-up on first use, or the first scan would seem slow.
                run.center_on(frame.T_map_base[:3, 3] if middle is None else middle)
            with defer_interrupts():
                run.add(frame, None if options.fixed else frame.T_map_base)
                after(run, frame)
            between(run, frame)
    except (KeyboardInterrupt, Exception) as reason:
        return reason
    return None


def show_progress(values: Iterable, doing: str, unit: str) -> Iterator:
    """Iterate with a progress bar on a terminal; print nothing where stderr is redirected."""
    from tqdm import tqdm

    yield from tqdm(values, desc=doing, unit=unit, disable=None, leave=False)
