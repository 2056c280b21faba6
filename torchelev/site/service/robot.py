"""A robot's link to the merger of a site."""

from __future__ import annotations

import threading
import time as clocks
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.maps.centering import center_on
from torchelev.site.areas import require_resolution
from torchelev.site.content.reading import Clock
from torchelev.site.fusion.merge import MergeReport
from torchelev.site.fusion.windows import Known, no_contribution, read_known
from torchelev.site.initialize_from_site import fill_windows, spread
from torchelev.site.service.outbox import MAX_WAITING, Outbox
from torchelev.site.service.reader import HEIGHTS, SiteReader
from torchelev.site.service.snapshots import read_snapshot
from torchelev.site.service.wire.access import check_key, check_name
from torchelev.site.service.wire.transport import Channel, open_channel
from torchelev.site.times import check_time
from torchelev.state import MapState, map_layers

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

_FLUSH = 10.0  # [s] that `initialize_from` waits for what is still to be acknowledged
_IDLE = 0.25  # [s] between looks at the clock


class RobotLink(SiteReader):
    """Sends what a map measures to a site's merger, and fills maps with what the site knows.

    ```python
    link = RobotLink(emap, "spot-1", connect="tcp/10.0.0.5:7450")
    emap.initialize_from(link, T_map_base)
    while walking:
        emap.update(points, T_map_sensor, T_map_base, dt)
        link.publish()                                       # every second or so; does not wait
    link.flush()
    ```

    What is published is kept until the merger has acknowledged it, whatever the network does; see `waiting_bytes`.

    Args:
        emap: the map, of the site's resolution.
        robot: its name, which no other robot of the site has.
        envs: environments of the map that are this robot's windows, int64; None: all.
        site: name of the site on the network.
        connect: where a merger or a Zenoh router listens, such as "tcp/127.0.0.1:7450".
        config: file of Zenoh's own configuration, for TLS and users, in place of `connect`.
        key: of this robot, if the merger has keys.
        max_waiting: bytes of cells that have left the windows and may wait to be sent. Beyond, the oldest are given up
            with a RuntimeWarning.
        channel: to send by in place of Zenoh, which `connect` and `config` are of.
        on_version: called with each new version of the site, in a thread of the network; None: nobody.

    Raises:
        TypeError: `emap` is not an ElevationMap.
        ValueError: a name has other characters than letters, digits, _ . and -, or the key is too short.
        ModuleNotFoundError: eclipse-zenoh is missing.
    """

    def __init__(
        self,
        emap: ElevationMap,
        robot: str,
        *,
        envs: Int[Tensor, "E"] | None = None,
        site: str = "site",
        connect: str | Sequence[str] | None = None,
        config: str | Path | None = None,
        key: str | None = None,
        max_waiting: int = MAX_WAITING,
        channel: Channel | None = None,
        on_version: Callable[[str], None] | None = None,
    ) -> None:
        actual, hint = type(emap).__name__, "give an ElevationMap"
        require(isinstance(emap, ElevationMap), "emap", "must be an ElevationMap", actual, hint, TypeError)
        self._emap, self._envs = emap, torch.arange(emap.num_envs) if envs is None else envs.cpu()
        own_key = None if key is None else check_key("key", key)
        self._outbox = Outbox(check_name("robot", robot), emap.cfg.grid.resolution, own_key, max_waiting)
        self._changed, self._is_closed = threading.Condition(threading.RLock()), False
        channel = open_channel(check_name("site", site), connect, config, robot) if channel is None else channel
        super().__init__(site, channel=channel, on_version=on_version)
        self._sender = threading.Thread(target=self._send_all, name=f"torchelev {robot}", daemon=True)
        self._sender.start()

    # Writing --------------------------------------------------------------------------------------------------------

    def publish(self, time: float | None = None) -> None:
        """Take a copy of what the map knows now, to be sent; does not wait for the network.

        Call it every second or so, and before cells leave the windows or `reset`: the map forgets them.

        Args:
            time: [s] now, on a clock that all robots and the merger share; None: `time.time()`.

        Raises:
            RefusedError: the merger refuses this robot.
            ValueError: `time` is not in seconds.
        """
        self._raise_refused()
        given = check_time(time)
        with torch.no_grad():
            snapshot = read_snapshot(self._emap, self._envs, clocks.time() if given is None else given)
        with self._changed, torch.no_grad():
            self._outbox.add(snapshot)
            self._changed.notify_all()

    def flush(self, timeout: float = _FLUSH) -> bool:
        """Wait until the site has all that was published; return whether it has, within `timeout` [s].

        Raises:
            RefusedError: the merger refuses this robot.
        """
        with self._changed:
            done = self._changed.wait_for(lambda: self._outbox.is_empty or self._outbox.error is not None, timeout)
        self._raise_refused()
        return done

    def _raise_refused(self) -> None:
        if self._outbox.error is not None:
            raise self._outbox.error

    @property
    def robot(self) -> str:
        """Name of this robot."""
        return self._outbox.robot

    @property
    def num_acknowledged(self) -> int:
        """Messages of this link that the site has."""
        return self._outbox.num_acknowledged

    @property
    def waiting_bytes(self) -> int:
        """Bytes of cells that have left the windows and wait to be sent."""
        with self._changed:
            return self._outbox.waiting_bytes

    @property
    def dropped_cells(self) -> int:
        """Cells that were given up because more than `max_waiting` bytes waited: the site will not have them."""
        return self._outbox.dropped_cells

    @property
    def report(self) -> MergeReport | None:
        """Offsets and counts of the last merge that was acknowledged; contradictions are -1 if not known."""
        return self._outbox.report

    def _receive(self, payload: bytes) -> None:
        with self._changed, torch.no_grad():
            self._outbox.receive(payload, clocks.monotonic())
            version = self._outbox.version
            self._changed.notify_all()
        self._set_version(version)

    def _on_merger(self) -> None:
        with self._changed:
            self._outbox.hurry()
            self._changed.notify_all()

    def _send_all(self) -> None:
        """Send what is due until the link is closed."""
        while not self._is_closed:
            with self._changed, torch.no_grad():
                payload = self._outbox.next_message(clocks.monotonic())
                if payload is None:
                    self._changed.notify_all()  # what waited may have held nothing new
                    self._changed.wait(_IDLE)
            if payload is not None and not self._is_closed:
                self._channel.send(payload)

    def close(self) -> None:
        """Leave the network. What the site has not acknowledged is lost: `flush` before."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._sender.join(timeout=5.0)
        super().close()

    # Reading --------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def fill_state(self, emap: ElevationMap, T_map_base: Tensor | None, chosen: Bool[Tensor, "B"]) -> MapState:
        """Return the map's state with what the site knows filled in; `ElevationMap.initialize_from` calls it.

        Raises:
            ValueError: it is another map than the link's, or environments are chosen that are not the link's.
            TimeoutError: no merger has answered.
        """
        require(emap is self._emap, "site", "must be a link of this map", "one of another", "make a link for this map")
        own = torch.zeros(emap.num_envs, dtype=torch.bool).index_fill_(0, self._envs, True)
        chosen = chosen.cpu()
        hint = "give env_ids that the link has"
        require(not (chosen & ~own).any(), "env_ids", "must be environments of the link", "others", hint)
        if not self.flush():
            raise TimeoutError("site: a merger must acknowledge all that was published first, got no answer")
        whole = map_layers(lambda value: value.cpu(), emap.state)
        if T_map_base is not None:
            whole = center_on(whole, emap, T_map_base.cpu(), chosen)
        after = self._fill(whole, chosen)
        filled = map_layers(lambda all_, own: all_.index_copy(0, self._envs, own), whole, after)
        return map_layers(lambda value: value.to(emap.device), filled)

    def _fill(self, whole: MapState, chosen: Bool[Tensor, "B"]) -> MapState:
        """Return the state of the link's environments, filled; what comes from the site is noted as contributed."""
        envs, emap = self._envs, self._emap
        state, chosen = map_layers(lambda value: value.index_select(0, envs), whole), chosen[envs]
        ids, (H, W) = chosen.nonzero()[:, 0], state.elevation.shape[1:]
        areas = self.areas(state.corner[ids].tolist(), H, W, HEIGHTS)
        clock, resolution = Clock(*(float(areas.about[n]) for n in ("time", "rate"))), float(areas.about["resolution"])
        require_resolution(emap.cfg.grid.resolution, resolution)
        site = spread({name: torch.as_tensor(value) for name, value in areas.layers.items()}, ids, state.elevation)
        with self._changed:
            num_resets = emap.num_resets.cpu()[envs]
            was = self._outbox.recall(num_resets, state.elapsed)
            if was is None:
                known = Known(*(value.index_select(0, envs) for value in read_known(emap, whole, clock.time)))
                was = no_contribution(known, num_resets)
            filled = fill_windows(state, emap, site, was, chosen, clock, resolution)
            self._outbox.begin_with(filled.contribution)
        return filled.state
