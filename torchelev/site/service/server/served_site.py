"""A site that merges windows received as messages, and records their senders in the same commit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import torch

from torchelev.errors import require
from torchelev.site.fusion.merge import MergeReport, merge_windows
from torchelev.site.fusion.windows import Alignment, move_known
from torchelev.site.service.wire.windows import Received
from torchelev.site.site_map import SiteMap, describe_merge

if TYPE_CHECKING:
    from torchelev.site.fusion.windows import Windows

MakeNotes = Callable[[Alignment], Mapping[str, Any]]


class ServedSite(SiteMap):
    """A `SiteMap` that merges what robots sent."""

    def require_heights_alone(self) -> None:
        """Raise ValueError if the site keeps channels, levels or keyframes, which messages cannot carry."""
        kept = {"channels": bool(self._tiles.channels), "levels": self._tiles.levels.cfg is not None}
        kept["keyframes"] = self._keyframes is not None
        names = " and ".join(name for name, is_kept in kept.items() if is_kept)
        hint = "merge into it in one process, with SiteMap.merge"
        require(not names, "path", "must be a site of heights alone to be served", f"one with {names}", hint)

    @property
    def id(self) -> str:
        """Which site this is; copies of its folder have the same."""
        return self._id

    @property
    def rate(self) -> float:
        """[m^2/s] at which variances grow; 0 before the first merge."""
        return self._clock.rate

    @property
    def notes(self) -> dict[str, Any]:
        """The last commit's note on each robot."""
        return self._robots

    def turn(self) -> AbstractContextManager[None]:
        """Keep other writers of a folder out until the end of the block, and show the newest version."""
        return self._turn()

    @torch.inference_mode(False)
    @torch.no_grad()
    def merge_received(self, received: Received, make_notes: MakeNotes, *, align: bool, tilt: bool) -> MergeReport:
        """Fuse windows that robots sent, and record it in the same commit: both are stored, or neither.

        Args:
            received: windows of one or several robots.
            make_notes: returns the notes on these robots, given the alignment of their windows.
            align: find the windows' offsets.
            tilt: also find how they tilt.

        Raises:
            Overtaken: another writer has changed the same tiles or notes since the turn began; nothing is stored.
            OSError: the disk is full or the store cannot be reached; `refresh` shows whether it is stored.
        """
        self._require_writable()
        windows, latest = received.windows, float(received.windows.known.now.max())
        if self._rate is None:
            self._rate = float(windows.known.rate[0])
        now = self._count_from_epoch(latest)
        windows = _since(self._epoch, windows)
        alignment = _keep_last(self._align(windows, align, tilt), received, align)
        parts = merge_windows(self._tiles, windows, alignment, self.resolution, self._clock.rate, self.cfg)
        before, self._robots = self._robots, {**self._robots, **make_notes(alignment)}
        number, new_cells = self._num_commits, windows.is_new.flatten(1).sum(1)
        history = describe_merge(len(new_cells), int(new_cells.sum()))
        try:
            contradictions = self._write(parts, max(self._time, now), len(new_cells), note=history)
        except BaseException:
            if self._num_commits == number:
                self._robots = before
            raise
        self._compact_in_time()
        self._raise_interrupted()
        return MergeReport(*alignment, new_cells, contradictions)


def _since(epoch: float, windows: Windows) -> Windows:
    """Return windows whose times count from the site's epoch [s], with what was known before moved to them."""
    known, was, before = windows.known, windows.contribution, None
    if was is not None:
        was = was._replace(known=was.known._replace(now=was.known.now - epoch))
        before = move_known(was.known, known.corner)
    return windows._replace(known=known._replace(now=known.now - epoch), contribution=was, before=before)


def _keep_last(alignment: Alignment, received: Received, align: bool) -> Alignment:
    """Return the alignment; isolated windows keep their last offset, even if all their cells have left since."""
    keeps = alignment.is_isolated & received.offset.isfinite()
    return alignment._replace(offset=torch.where(keeps, received.offset, alignment.offset)) if align else alignment
