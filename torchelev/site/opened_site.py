"""Opening a site, in memory or on disk, and writing to it: what `SiteMap` stands on."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchelev.errors import require, require_positive
from torchelev.inputs import checks
from torchelev.site.content.channels import SiteChannels
from torchelev.site.content.levels import SiteLevels
from torchelev.site.content.tiles import LAYERS, Tile, Tiles
from torchelev.site.fusion.exchange import Exchange
from torchelev.site.fusion.merge import Merged
from torchelev.site.keyframes.keyframe_log import Arrays, KeyframeLog
from torchelev.site.readable_site import ReadableSite
from torchelev.site.shared.collective import shared_transaction
from torchelev.site.shared.exchange import exchange_of
from torchelev.site.shared.ranks import Ranks
from torchelev.site.site_config import SiteConfig
from torchelev.site.storage.engines import open_store
from torchelev.site.storage.interface import Note

if TYPE_CHECKING:
    from jaxtyping import Int
    from torch import Tensor
    from typing_extensions import Self


class OpenedSite(ReadableSite):
    """A site that has been opened: its settings, its attributes on disk, and its commits."""

    cfg: SiteConfig
    _ranks: Ranks
    _exchange: Exchange
    _keyframes: KeyframeLog | None
    _id: str
    _opened: float
    _num_commits: int
    _interrupted: BaseException | None
    _robots: dict[str, Any]  # what `torchelev.site.service` noted of each robot's last merge
    _rasters: list[dict[str, Any]]

    @classmethod
    def open(
        cls,
        path: str | Path,
        version: str | None = None,
        *,
        read_only: bool = False,
        cfg: SiteConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> Self:
        """Open a site that is on disk or in an object store.

        Args:
            path: its folder, or s3://bucket/prefix.
            version: id or tag of the version to show, which is read-only and stays as it is; None: the newest.
            read_only: read beside processes that write; `refresh` shows what they have written since.
            cfg: how windows are aligned and fused.
            device: that fuses.

        Raises:
            FileNotFoundError: there is nothing; ``SiteMap(resolution=..., path=...)`` makes a site.
            KeyError: there is no such version.
            ValueError: it is not a site, is damaged, or has a newer format.
            OSError: it cannot be reached or read, or another process writes to a site of files.
        """
        site = cls.__new__(cls)
        site._ranks = Ranks(None)
        site._store = open_store(path, read_only=read_only, version=version)
        site.resolution = float(site._store.attributes["resolution"])
        site.cfg = checks.given_or_default(SiteConfig, cfg)
        site._keyframes = None
        with site._closed_on_failure():
            site._begin(device)
        return site

    @contextmanager
    def _closed_on_failure(self) -> Iterator[None]:
        """Let other writers in if the block fails."""
        try:
            yield
        except BaseException:
            if self._store is not None:
                self._store.close()
            raise

    def _begin(
        self, device: torch.device | str, channels: SiteChannels | None = None, levels: SiteLevels | None = None
    ) -> None:
        """Start with what is stored, or with nothing."""
        if self._store is not None:  # a site without channels may lack the attribute
            channels = SiteChannels(self._store.attributes.get("channels"), LAYERS, self._store.layers)
            levels = SiteLevels.of(self._store.attributes)
        self._tiles = Tiles(self._store, self.cfg.cache_tiles, device, channels, levels)
        self._exchange = exchange_of(self._ranks)
        self._id, self._rate = uuid.uuid4().hex, self.cfg.variance_rate
        self._epoch = self._time = self._opened = 0.0  # the last two are relative to the first
        self._num_commits, self._interrupted, self._rasters, self._robots = 0, None, [], {}
        self._rollbacks: list[list[int]] = []
        self._read_attributes()

    def _check_kept(self, wanted: bool, channels: SiteChannels, levels: SiteLevels) -> None:
        """Raise ValueError unless the site can keep keyframes, channels and levels as wanted."""
        kept, hint = self._keyframes is not None, "begin another"
        own = self._tiles.channels
        try:
            require(kept or not wanted, "keyframes", "must be kept from the first merge on", "a site without", hint)
            hint = "merge in one process, or without keyframes"
            require(not kept or self._ranks.size == 1, "keyframes, group", "exclude each other", "both", hint)
            is_alone, hint = not (kept or self._ranks.size > 1), "keep one of them"
            require(not own or is_alone, "channels, keyframes and group", "exclude each other", "several", hint)
            rule, actual = "must be kept from the first merge on", ", ".join(channels.layers)
            require(not channels or own.configs == channels.configs, "channels", rule, actual,
                    f"leave them out: the site has {', '.join(own.layers) or 'none'}")  # fmt: skip
            self._tiles.levels.require_alone(is_alone)
            self._tiles.levels.require_same(levels)
        except ValueError:
            self.close()
            raise

    def _set_up(self, resolution: float, path: str | Path | None, cfg: SiteConfig | None) -> dict[str, Any]:
        """Take the settings, and return those that all ranks must share."""
        require_positive(resolution=resolution)
        self.resolution = float(resolution)
        self.cfg = checks.given_or_default(SiteConfig, cfg)
        settings = {f"cfg.{name}": value for name, value in asdict(self.cfg).items() if name != "cache_tiles"}
        return {"resolution": self.resolution, "path": "in memory" if path is None else "on disk", **settings}

    def _agree_on_id(self) -> None:
        """Take the id of rank 0; raise ValueError if ranks have opened different sites."""
        stored = None if self._store is None else self._store.attributes.get("id")
        try:
            plans = self._ranks.exchange("SiteMap", lambda: {"id": self._id, "same": {"path: id of the site": stored}})
        except BaseException:
            self.close()
            raise
        self._id = plans[0]["id"]

    def _attributes(self, time: float, new_merges: int) -> dict[str, Any]:
        own = {"resolution": self.resolution, "id": self._id, "epoch": self._epoch, "time": time}
        own["num_commits"] = self._num_commits + 1
        merges = None if self._keyframes is None else self._keyframes.num_merges + new_merges
        own["channels"], own["rasters"] = self._tiles.channels.attributes, self._rasters
        own |= self._tiles.levels.attributes | ({"rollbacks": self._rollbacks} if self._rollbacks else {})
        own |= {"robots": self._robots} if self._robots else {}
        return own | {"variance_rate": self._rate, "keyframe_merges": merges}

    def _read_attributes(self) -> None:
        stored = {} if self._store is None else self._store.attributes
        self._id, self._rollbacks = stored.get("id", self._id), stored.get("rollbacks", [])
        self._robots = stored.get("robots", {})
        self._rasters, self._num_commits = list(stored.get("rasters", [])), stored.get("num_commits", 0)
        if self._num_commits:  # a new site, or one rolled back to its start, has no more
            self._epoch, self._time = stored.get("epoch", 0.0), stored.get("time", 0.0)
            self._opened = self._time
            rate = self.cfg.variance_rate
            self._rate = stored.get("variance_rate") if rate is None else rate
            merges = stored.get("keyframe_merges", 0 if "epoch" not in stored and self._keyframes else None)
            rule, hint = "must be kept from the first merge on", "begin another site: a writer without merged first"
            require(merges is not None or self._keyframes is None, "keyframes", rule, "a site without", hint)
            self._keyframes = None if merges is None else KeyframeLog(self._store, merges)

    def _are_of_others(self, tiles: list[Tile]) -> list[bool]:
        """Return which tiles other ranks fuse."""
        x, y = torch.tensor(tiles, dtype=torch.int64, device=self._tiles.device).view(-1, 2).unbind(1)
        return (self._exchange.find_owners(x, y) != self._ranks.rank).tolist()

    # Writing --------------------------------------------------------------------------------------------------------

    def _require_writable(self) -> None:
        if self._store is not None:
            hint = "open it again with SiteMap(resolution=..., path=...)"
            require(not self._store.is_closed, "site", "must be open", "a site after close()", hint)
            is_reader = self._store.is_read_only and self._ranks.rank == 0
            require(not is_reader, "site", "must be open for writing", "a read-only site", "open it without read_only")

    def _write(
        self,
        parts: Iterable[Merged],
        time: float,
        size: int,
        arrays: Arrays | None = None,
        merges: int = 0,
        note: Note | None = None,
    ) -> Int[Tensor, "B"]:
        """Write tiles and arrays, on disk first; return the sum of the contradictions."""
        contradictions = torch.zeros(size, dtype=torch.int64, device=self._tiles.device)
        attributes = self._attributes(time, merges)
        before = None if self._store is None else self._store.version
        try:
            with shared_transaction(self._ranks, self._store, attributes, arrays, note) as write:
                for part in parts:
                    write(part.tiles, part.values.transpose(0, 1).cpu().numpy())
                    self._tiles.write(part.tiles, part.values)
                    contradictions += part.contradictions
        except BaseException as error:
            self._tiles.forget()
            if self._store is None or self._store.version == before:
                raise
            self._interrupted = error  # after the commit: raised once memory has followed
        stored = attributes if self._store is None or self._ranks.size > 1 else self._store.attributes
        if stored["num_commits"] > attributes["num_commits"]:  # on top of another writer's tiles
            self._tiles.forget()
        self._time, self._num_commits = stored["time"], stored["num_commits"]
        if self._ranks.size > 1:  # other ranks have written theirs
            self._tiles.forget(self._are_of_others)
        return contradictions

    def _raise_interrupted(self) -> None:
        """Raise what interrupted a merge that was committed."""
        if self._interrupted is not None:
            error, self._interrupted = self._interrupted, None
            raise error
