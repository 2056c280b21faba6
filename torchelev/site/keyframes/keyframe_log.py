"""Where a site's keyframes are kept: in memory, or on disk beside its tiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.site.keyframes.keyframes import LAYERS, Keyframes, Recorded, Rows, join, no_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from torchelev.site.storage.interface import SiteStore

Arrays = dict[str, tuple["NDArray", Mapping[str, Any]]]
# Rows that are stored as attributes, and their names there, which stored sites fix.
_LISTS = {"robot": "robot", "previous": "told_of", "corner": "corner", "size": "size", "heights": "heights"}


class KeyframeLog:
    """All keyframes of a site.

    On disk, `keyframes/<id>` is one (8, H, W) float32, which never changes, and `merges/<number>` holds the poses of
    those of a merge, (2, B, 4, 4) float64: at the merge, and corrected.

    Args:
        store: of the site; None: in memory.
        num_merges: that are in the store.
    """

    def __init__(self, store: SiteStore | None, num_merges: int = 0) -> None:
        self._store, self.num_merges = store, num_merges
        self._rows = None if num_merges else no_rows()
        self._layers: list[Tensor] = []

    @property
    def rows(self) -> Rows:
        """The metadata of all keyframes; reads a small file for each merge the first time."""
        if self._rows is None:
            self._rows = join(*(self._read_merge(number) for number in range(self.num_merges)))
        return self._rows

    def list(self) -> Keyframes:
        """Return copies of the keyframes' public metadata."""
        rows = self.rows
        return Keyframes(torch.arange(len(rows.merge)), rows.robot.clone(), rows.time.clone(), rows.T_now.clone())

    def read(self, number: int) -> Tensor:
        """Return a keyframe's layers."""
        if self._store is None:
            return self._layers[number]
        return torch.from_numpy(self._store.read_array(_keyframe(number))[0])

    def append(self, new: Recorded) -> None:
        """Add the keyframes of a merge that has been stored."""
        self._rows, self.num_merges = join(self.rows, new.rows), self.num_merges + 1
        if self._store is None:
            self._layers += new.layers

    def replace(self, rows: Rows) -> None:
        """Take over corrected poses that have been stored."""
        self._rows = rows

    def _read_merge(self, number: int) -> Rows:
        assert self._store is not None
        poses, attributes = self._store.read_array(_merge(number))
        first, now = torch.from_numpy(poses)
        values = {name: torch.tensor(attributes[stored]) for name, stored in _LISTS.items()}
        values["heights"] = values["heights"].double()
        merge, time = torch.full((len(first),), number), torch.full((len(first),), attributes["time"]).double()
        return Rows(merge=merge, time=time, T_first=first, T_now=now, **values)


def arrays_of(new: Recorded) -> Arrays:
    """Return the arrays to store for a merge."""
    number = int(new.rows.merge[0])
    attributes = {"layers": list(LAYERS)}
    layers = {
        _keyframe(key): (value.numpy(), attributes) for key, value in zip(new.ids.tolist(), new.layers, strict=True)
    }
    return {**layers, **_pose_array(number, new.rows)}


def changed_arrays(before: Rows, after: Rows) -> Arrays:
    """Return the arrays of poses to store after a correction."""
    changed = after.merge[(before.T_now != after.T_now).flatten(1).any(1)].unique()
    arrays: Arrays = {}
    for number in changed.tolist():
        mask = after.merge == number
        arrays |= _pose_array(number, Rows(*(value[mask] for value in after)))
    return arrays


def _pose_array(number: int, rows: Rows) -> Arrays:
    attributes = {stored: getattr(rows, name).tolist() for name, stored in _LISTS.items()} | {
        "time": float(rows.time[0])
    }
    return {_merge(number): (torch.stack([rows.T_first, rows.T_now]).numpy(), attributes)}


def _keyframe(number: int) -> str:
    return f"keyframes/{number:08d}"


def _merge(number: int) -> str:
    return f"merges/{number:08d}"
