"""What a robot still has to send: one message at a time, each until it is acknowledged.

Snapshots of which none has been sent become one: a later one holds all that an earlier one knew, except for the cells
that have left the window since, which wait apart. So a robot that stands for an hour without a connection keeps one
snapshot, and one that moves keeps each cell that it leaves once.
"""

from __future__ import annotations

import uuid
import warnings
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.site.areas import require_resolution
from torchelev.site.fusion.merge import MergeReport
from torchelev.site.fusion.windows import Contribution, Windows, drop_reset, move_known
from torchelev.site.service.ledger import OTHER_SITE, TAKEN
from torchelev.site.service.snapshots import Snapshot, find_left, join, make_windows
from torchelev.site.service.wire.alignment import read_alignment
from torchelev.site.service.wire.messages import MessageError, OtherVersionError, decode, encode, take_count, take_text
from torchelev.site.service.wire.windows import layout_of, sizes_of, to_arrays

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

_FIRST_RETRY, _LAST_RETRY = 1.0, 5.0  # [s] after which a message is sent again, doubled each time
_PATIENCE = 10.0  # [s] for which another merger's refusals are taken for a mistake that ends
MAX_WAITING = 1 << 28  # bytes


class RefusedError(RuntimeError):
    """The merger refuses what this robot sends, for a reason that sending again does not remove."""


class _Left(NamedTuple):
    """Cells that have left the windows and wait to be sent."""

    corner: Int[Tensor, "B 2"]
    mask: Bool[Tensor, "B H W"]
    part: Snapshot | None  # None: it was sent with the windows, or dropped as too much waited


class _Flight(NamedTuple):
    """What has been sent and is not acknowledged."""

    windows: Windows
    snapshot: Snapshot
    left: _Left | None  # None: the windows as a whole


class Outbox:
    """The messages of one robot.

    Args:
        robot: its name.
        resolution: [m] of its map.
        key: to sign with; None: nothing is signed.
        max_waiting: bytes of cells that have left the windows and may wait.

    Attributes:
        error: why the merger refuses this robot; None: it does not.
        version: the newest version of the site that is known here; "" before the first.
        dropped_cells: how many cells were given up because too much waited.
        num_acknowledged: messages that the site has.
        report: of the last merge; None before.
    """

    def __init__(self, robot: str, resolution: float, key: bytes | None = None, max_waiting: int = MAX_WAITING) -> None:
        self.robot, self.resolution, self.max_waiting = robot, resolution, max_waiting
        self.error: RefusedError | None = None
        self.version, self.dropped_cells, self.num_acknowledged = "", 0, 0
        self.report: MergeReport | None = None
        self.contribution: Contribution | None = None
        self._key, self._link = key, uuid.uuid4().hex
        self._site, self._epoch = "", 0
        self._left: deque[_Left] = deque()
        self._latest: Snapshot | None = None  # not sent
        self._last: Snapshot | None = None  # sent or not
        self._flight: _Flight | None = None
        self._payload: bytes | None = None
        self._offset: Tensor | None = None
        self._other_since: float | None = None
        self._due, self._retry = 0.0, _FIRST_RETRY

    @property
    def is_empty(self) -> bool:
        """Whether the site has all that was added."""
        return self._flight is None and self._latest is None and not self._left

    @property
    def is_welcome(self) -> bool:
        """Whether a merger has answered."""
        return self._epoch > 0

    @property
    def waiting_bytes(self) -> int:
        """Bytes of cells that have left the windows and wait."""
        return sum(left.part.num_bytes for left in self._left if left.part is not None)

    # What the robot knows -------------------------------------------------------------------------------------------

    def add(self, snapshot: Snapshot) -> None:
        """Add a snapshot of what the windows know now."""
        part = None if self._last is None else find_left(self._last, snapshot)
        if part is not None and part.counts.any():
            if self._latest is not None:
                self._keep(part)
            else:  # it has been sent with all others
                self._left.append(_Left(part.known.corner, part.known.is_known, None))
        self._latest = self._last = snapshot

    def _keep(self, part: Snapshot) -> None:
        last = self._left[-1].part if self._left else None
        joined = None if last is None else join(last, part)
        if joined is not None:
            self._left.pop()
            part = joined
        self._left.append(_Left(part.known.corner, part.known.is_known, part))
        while self.waiting_bytes > self.max_waiting:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Give up the oldest part that waits, and say so."""
        k = next(k for k, left in enumerate(self._left) if left.part is not None)
        self.dropped_cells += int(self._left[k].part.counts.sum())  # type: ignore[union-attr]
        self._left[k] = self._left[k]._replace(part=None)
        text = f"robot {self.robot}: more than {self.max_waiting >> 20} MiB wait for the site's merger; "
        warnings.warn(text + f"{self.dropped_cells} cells were given up, the oldest ones", RuntimeWarning, stacklevel=5)

    # Sending --------------------------------------------------------------------------------------------------------

    def next_message(self, now: float) -> bytes | None:
        """Return what to send now, or None. It may be what was sent before.

        Args:
            now: [s] of any clock that does not go back.
        """
        if self.error is not None or now < self._due:
            return None
        if not self.is_welcome:
            self._wait_from(now)
            return encode(self._header("hello"), key=self._key)
        if self._flight is None and not self._take_off():
            return None
        self._wait_from(now)
        try:
            self._payload = self._payload or self._encode()
        except MessageError as error:
            self.error = RefusedError(f"robot {self.robot}: {error}")
        return self._payload

    def hurry(self) -> None:
        """Send what is due at once, as a merger has appeared."""
        self._due, self._retry = 0.0, _FIRST_RETRY

    def _wait_from(self, now: float) -> None:
        self._due, self._retry = now + self._retry, min(2 * self._retry, _LAST_RETRY)

    def _header(self, kind: str) -> dict[str, Any]:
        return {"kind": kind, "robot": self.robot, "link": self._link, "resolution": self.resolution}

    def _encode(self) -> bytes:
        assert self._flight is not None
        windows = self._flight.windows
        offset = windows.known.now * torch.nan if self._offset is None else self._offset
        sender = {"site": self._site, "epoch": self._epoch, "number": self.num_acknowledged + 1}
        header = self._header("windows") | sender | sizes_of(windows)
        return encode(header, layout_of(header), to_arrays(windows, offset), self._key)

    def _take_off(self) -> bool:
        """Choose what to send next; return whether there is anything new."""
        while self._left:
            left = self._left.popleft()
            if left.part is not None and self._fly(left.part, left):
                return True
            self._forget(left)
        latest, self._latest = self._latest, None
        return latest is not None and self._fly(latest, None)

    def _fly(self, snapshot: Snapshot, left: _Left | None) -> bool:
        windows = make_windows(snapshot, self.recall(snapshot.num_resets, snapshot.elapsed))
        if not (windows.is_new | windows.is_bounded).any():
            return False
        self._flight, self._payload = _Flight(windows, snapshot, left), None
        return True

    def recall(self, num_resets: Int[Tensor, "B"], elapsed: Int[Tensor, "B"]) -> Contribution | None:
        """Return what the site has of the maps, and forget it of those that were reset since; None: nothing."""
        was = self.contribution
        if was is not None:
            was_reset = (was.num_resets != num_resets) | (elapsed < was.elapsed)
            self.contribution = drop_reset(was, num_resets, elapsed)
            if self._offset is not None:
                self._offset = torch.where(was_reset, torch.nan, self._offset)
        return self.contribution

    def begin_with(self, contribution: Contribution) -> None:
        """Take what the maps know now as their contribution: they were filled from the site, and nothing waits."""
        known, zero = contribution.known, torch.zeros_like(contribution.known.elevation)
        surface = zero, zero, zero.bool(), zero, zero.bool()
        self._last = Snapshot(known, *surface, known.age, contribution.elapsed, contribution.num_resets)
        self.contribution = contribution

    # Answers --------------------------------------------------------------------------------------------------------

    def receive(self, payload: bytes, now: float) -> bool:
        """Handle an answer of a merger; return whether it was one. Late and repeated answers are ignored, too."""
        try:
            message = decode(payload)
            header = message.header
            kind = take_text(header, "kind")
            if kind == "version":
                return self._note_version(header)
            if self._key is not None and not message.is_signed_with(self._key):
                return False
            if take_text(header, "link") != self._link:
                return False
            return {"welcome": self._welcome, "merged": self._land, "refused": self._refuse}[kind](header, now)
        except OtherVersionError as error:
            self.error = RefusedError(f"robot {self.robot}: {error}")
            return True
        except (MessageError, KeyError, TypeError, ValueError):
            return False

    def _note_version(self, header: Mapping[str, Any]) -> bool:
        if self._site not in ("", header["site"]):
            return False
        self.version = take_text(header, "version")
        return True

    def _welcome(self, header: Mapping[str, Any], now: float) -> bool:
        if self.is_welcome:
            return False
        of_site = float(header["resolution"])
        try:
            require_resolution(self.resolution, of_site)
        except ValueError as error:
            self.error = RefusedError(str(error))
            return True
        self._site, self._epoch = take_text(header, "site"), take_count(header, "epoch")
        self.version = take_text(header, "version")
        self.hurry()
        return True

    def _land(self, header: Mapping[str, Any], now: float) -> bool:
        """Handle an acknowledgement."""
        flight = self._flight
        is_own = (header["epoch"], header["number"]) == (self._epoch, self.num_acknowledged + 1)
        if flight is None or not is_own or header["site"] != self._site:
            return False
        alignment = read_alignment(header, len(flight.snapshot.elapsed))
        self.version, self._offset = take_text(header, "version"), alignment.offset
        counts = (torch.tensor(header[name]) for name in ("new_cells", "contradictions"))
        self.report = MergeReport(*alignment, *counts)
        self.num_acknowledged += 1
        if flight.left is not None:
            self._forget(flight.left)
        else:
            own = flight.snapshot
            none = torch.full_like(own.elapsed, -1)
            self.contribution = Contribution(own.known, alignment, own.elapsed, own.num_resets, none)
        self._flight = self._payload = self._other_since = None
        self.hurry()
        return True

    def _forget(self, left: _Left) -> None:
        """Drop cells from the contribution that have left the windows: if they come back, they are measured again."""
        was = self.contribution
        if was is None:
            return
        moved = move_known(was.known._replace(corner=left.corner, is_known=left.mask), was.known.corner)
        known = was.known._replace(is_known=was.known.is_known & ~moved.is_known)
        self.contribution = was._replace(known=known)

    def _refuse(self, header: Mapping[str, Any], now: float) -> bool:
        if header.get("number") not in (None, self.num_acknowledged + 1):
            return False  # of a message that has been merged since
        reason, text = take_text(header, "reason"), take_text(header, "text", 1000)
        if reason == TAKEN and not self.num_acknowledged:
            self._epoch, self._payload = 0, None
            self._link = uuid.uuid4().hex
            self.hurry()
        elif reason == OTHER_SITE and now - (self._other_since or now) < _PATIENCE:
            self._other_since = self._other_since or now
        else:
            self.error = RefusedError(f"robot {self.robot}: {text}")
        return True
