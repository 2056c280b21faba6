"""The versions of a site, and its turns beside other writers: what `SiteMap` adds to an opened site."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from torchelev.errors import message, require
from torchelev.site import contributions
from torchelev.site.fusion.windows import Contribution
from torchelev.site.opened_site import OpenedSite
from torchelev.site.storage.interface import InDoubtError, Overtaken

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap
    from torchelev.site.storage.interface import SiteStore, Version

T = TypeVar("T")


class VersionedSite(OpenedSite):
    """A site that knows its versions: each merge makes one."""

    _is_broken = False  # a group whose last commit is in doubt
    _in_doubt: tuple[str, ElevationMap, Contribution] | None = None  # a commit, and what it would have contributed

    @property
    def version(self) -> str:
        """Id of the version that the site shows: of its last merge, or of the one that it was opened at.

        In memory and of a site of files, the number of merges.
        """
        return str(self._num_commits) if self._store is None else self._store.version

    def versions(self) -> list[Version]:
        """Return all versions, the newest first, and behind them those that tags alone keep.

        A site of files has one, the present one.

        Returns:
            Their ids, times, messages, tags, and the robots and new cells of their merges.

        Raises:
            ValueError: the site is in memory.
            OSError: the store cannot be read.
        """
        return self._require_store("versions").versions()

    def tag(self, name: str, version: str | None = None) -> None:
        """Name a version, such as "spring-survey": ``SiteMap.open(path, "spring-survey")`` shows it.

        A version with a tag stays, whatever `compact` drops.

        Args:
            name: new, of letters, digits, ".", "_" and "-".
            version: id or tag; None: the one that the site shows.

        Raises:
            KeyError: there is no such version.
            ValueError: the name is invalid, is or was taken, or the site is read-only, closed, in memory or of files.
            OSError: the store cannot be written.
        """
        store = self._require_store("tag")
        self._require_writable()
        store.tag(name, store.version if version is None else version)

    def rollback(self, version: str) -> str:
        """Make the site what it was at an earlier version.

        Nothing is lost: this makes a new version with the earlier one's content, and a tag keeps the one that was the
        newest until then. Robots whose last merge is taken back must reset their maps before they merge again: part of
        what they hold is in the site, and part is not.

        Args:
            version: id or tag.

        Returns:
            The tag of what was the newest version, such as "before-rollback-1"; "" if nothing had to change.

        Raises:
            KeyError: there is no such version.
            ValueError: the site is read-only, closed, in memory, of files, or shared by a group.
            OSError: the store cannot be written.
        """
        store = self._require_store("rollback")
        self._require_writable()
        require(self._ranks.size == 1, "rollback", "must be called in one process", "a group", "open it in one")
        kept = store.rollback(version)
        self.refresh()
        return kept

    def compact(self, keep: int | None = None) -> int:
        """Drop all versions but the newest ones and those with tags.

        Merges do this by themselves, each `SiteConfig.keep_versions` times.

        Args:
            keep: versions, at least 1; None: `SiteConfig.keep_versions`.

        Returns:
            The number of bytes that became free; 0 of a site of files, which keeps no history.

        Raises:
            ValueError: the site is read-only, closed, or in memory.
            OSError: the store cannot be written.
        """
        store = self._require_store("compact")
        self._require_writable()
        return store.compact(self.cfg.keep_versions if keep is None else keep)

    def _require_store(self, call: str) -> SiteStore:
        hint = "make the site with a path"
        require(self._store is not None, call, "must be of a site on disk or in an object store", "one in memory", hint)
        assert self._store is not None
        return self._store

    # Turns -----------------------------------------------------------------------------------------------------------

    def _in_turn(self, work: Callable[[], T]) -> T:
        """Call `work`, which commits on top of the newest version, until no other writer is faster; return its result.

        Raises:
            OSError: another process writes beside a group, or as of `work`.
        """
        with self._turn():
            while True:
                try:
                    result = work()
                except Overtaken:
                    if self._ranks.size > 1:
                        raise OSError("site: must have no other writer beside a group, got one: end it") from None
                    self.refresh()
                except InDoubtError:
                    self._is_broken = self._ranks.size > 1  # whose ranks would have to settle it together
                    raise
                else:
                    break
            self._compact_in_time()
        self._raise_interrupted()
        return result

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Let no other process write to a folder until the end of the block, and begin with the newest version."""
        if self._store is None or self._store.is_read_only or self._ranks.size > 1:
            yield
            return
        with self._store.turn() as is_behind:
            if is_behind:
                self.refresh()
            self._settle()
            yield

    def _settle(self) -> None:
        """Find out whether a commit is stored during which the connection ended."""
        if self._in_doubt is not None and self._store is not None:
            commit, emap, contribution = self._in_doubt
            if self._store.holds(commit):
                self.refresh()
                self._keep(emap, contribution)
            self._in_doubt = None

    def _keep(self, emap: ElevationMap, contribution: Contribution, number: int | None = None) -> None:
        """Remember what a map has contributed; `number`: of the commit, None: the last one."""
        number = self._num_commits if number is None else number
        contributions.keep(emap, self._id, contribution._replace(number=number))

    def _require_not_taken_back(self, emap: ElevationMap, contribution: Contribution | None) -> None:
        """Raise ValueError if a rollback has taken back the last merge of a map that has not been reset since."""
        if contribution is None:
            return
        is_taken_back = any(low < contribution.number < high for low, high in self._rollbacks)
        goes_on = contribution.num_resets == emap.num_resets.to(contribution.num_resets.device)
        actual = "one that goes on: the site holds only part of what it measured"
        rule = "must be reset after a rollback that took back its last merge"
        require(not (is_taken_back and bool(goes_on.any())), "emap", rule, actual, "call emap.reset()")

    def _compact_in_time(self) -> None:
        """Compact once in `keep_versions` merges; if that fails, the merge still holds."""
        if self._store is None or self._ranks.rank or self._num_commits % self.cfg.keep_versions:
            return
        try:
            self._store.compact(self.cfg.keep_versions)
        except OSError as error:
            text = message("site", "must be compacted", str(error), "call site.compact() later")
            warnings.warn(text, RuntimeWarning, stacklevel=2)
