"""The keyframes of a site, and moving them: what `SiteMap` adds to a site with versions."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.inputs import checks
from torchelev.site.fusion.windows import Alignment, Windows
from torchelev.site.keyframes.keyframe_log import KeyframeLog, changed_arrays
from torchelev.site.keyframes.keyframes import Keyframes, Recorded, correct, record
from torchelev.site.keyframes.rebuild import rebuild_moved
from torchelev.site.storage.interface import Note
from torchelev.site.versioned_site import VersionedSite

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from torchelev.elevation_map import ElevationMap


class KeyframedSite(VersionedSite):
    """A site that may keep keyframes."""

    @property
    def keyframes(self) -> Keyframes:
        """Ids, robots, times and poses of the keyframes; ValueError if the site keeps none."""
        return self._require_keyframes().list()

    @torch.inference_mode(False)  # whose tensors could not be written outside of it
    @torch.no_grad()
    def move_keyframes(self, ids: Int[Tensor, "K"], T_map_base: Float[Tensor, "K 4 4"]) -> None:
        """Correct the poses of keyframes, as a pose graph does after it closed a loop.

        The tiles below them are rebuilt from all keyframes there, in the order of their merges, so that the site
        becomes what mapping with these poses from the start would give: exactly for corrections along z and by whole
        cells, otherwise to the nearest cell. A pose replaces the offset and tilt of its merge, too. Other tiles keep
        every bit. On disk, all of it is written or nothing.

        The robots' own maps stay as they are. Correct them, too: otherwise, what they measure next is placed by the old
        poses.

        Args:
            ids: of the keyframes; see `keyframes`.
            T_map_base: their new poses; `keyframes.T_map_base` has the present ones.

        Raises:
            TypeError: an argument is not a tensor of the right kind.
            ValueError: the site keeps no keyframes, is read-only or closed, an id is unknown or repeats, or the poses
                are not rigid (K, 4, 4). Nothing has changed then.
            OSError: the disk is full; the site is as it was before.
        """
        self._require_keyframes()
        self._require_writable()
        self._in_turn(partial(self._move_keyframes, ids, T_map_base))

    def _move_keyframes(self, ids: Tensor, T_map_base: Tensor) -> None:
        """Move keyframes of the version that the site shows; Overtaken if it is no longer the newest one."""
        log = self._require_keyframes()
        after = correct(log.rows, ids, T_map_base)
        arrays = changed_arrays(log.rows, after)
        if arrays:
            parts = rebuild_moved(self._tiles, log, after, self.resolution, self._clock.rate, self.cfg)
            parts = (part._replace(contradictions=part.contradictions.sum()[None]) for part in parts)
            note = Note(f"{len(ids)} keyframe{'s' * (len(ids) != 1)} moved")
            self._write(parts if self._store else list(parts), self._time, 1, arrays, note=note)
            log.replace(after)

    def _require_keyframes(self) -> KeyframeLog:
        hint = "make it with SiteMap(..., keyframes=True)"
        require(self._keyframes is not None, "keyframes", "must be kept by the site", "a site without them", hint)
        assert self._keyframes is not None
        return self._keyframes

    def _record(self, windows: Windows, alignment: Alignment, T_map_base: Tensor | None, now: float) -> Recorded | None:
        """Return the keyframes of a merge; None if none are kept."""
        if self._keyframes is None or T_map_base is None:
            return None
        rows, number, time = self._keyframes.rows, self._keyframes.num_merges, self._epoch + max(self._time, now)
        return record(windows, alignment, T_map_base, rows, number, time, self.resolution)


def require_poses(emap: ElevationMap, T_map_base: Tensor | None) -> Tensor:
    """Return the poses of the robots; TypeError or ValueError if there are none or bad ones."""
    hint = "give the poses of the last update"
    require(T_map_base is not None, "T_map_base", "must be given, as keyframes are kept", None, hint)
    return checks.check_pose("T_map_base", T_map_base, (emap.num_envs, 4, 4), emap.device, True)
