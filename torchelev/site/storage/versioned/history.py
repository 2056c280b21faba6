"""The versions of a repository: listing, naming, going back, and forgetting."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta, timezone
from itertools import count
from pathlib import Path
from typing import Any

from torchelev.errors import require, require_count
from torchelev.site.storage.interface import Note, Version
from torchelev.site.storage.versioned.arrays import write_array
from torchelev.site.storage.zarr_files import encode_json

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_LOG = "history/rollbacks"  # name of an array
# What collecting holds in memory: by default, 400 merges over a square kilometre end with 190 MB more.
_FEW_AT_A_TIME = {
    "max_snapshots_in_memory": 1,
    "max_compressed_manifest_mem_bytes": 1 << 20,
    "max_concurrent_manifest_fetches": 1,
}
_LONGEST_MERGE = timedelta(minutes=10)  # chunks of an object store that are younger may belong to a commit on its way


def list_versions(repository: Any) -> list[Version]:
    """Return the versions of the branch, the newest first, and behind them those that tags alone keep."""
    tags = _read_tags(repository)
    versions = {each.id: _describe(each, tags) for each in _merges(repository, branch="main")}
    others = [_describe(repository.lookup_snapshot(each), tags) for each in tags.keys() - versions.keys()]
    return [*versions.values(), *sorted(others, key=lambda version: version.time, reverse=True)]


def find(repository: Any, path: str | Path, version: str) -> str:
    """Return the id of a version that is given by its id or tag; KeyError if there is none."""
    tags = {name: snapshot for snapshot, names in _read_tags(repository).items() for name in names}
    if version in tags:
        return tags[version]
    known = [each.id for each in list_versions(repository)]
    actual, hint = repr(version), f"{path} has {', '.join([*tags, *known[:5]])}; see site.versions()"
    require(version in known, "version", "must be the id or tag of a version", actual, hint, KeyError)
    return version


def is_in_history(repository: Any, snapshot: str, tip: str) -> bool:
    """Return whether a snapshot is the tip or one before it."""
    return any(each.id == snapshot for each in repository.ancestry(snapshot_id=tip))


def attributes_of(repository: Any, snapshot: str) -> dict[str, Any]:
    """Return the attributes that a version was stored with."""
    return dict(json.loads(repository.lookup_snapshot(snapshot).metadata.get("attributes", "{}")))


def is_whole(repository: Any, snapshot: str) -> bool:
    """Return whether something was committed to a repository after it was made."""
    return repository.lookup_snapshot(snapshot).parent_id is not None


def metadata_of(attributes: Mapping[str, Any], note: Note, key: str = "") -> dict[str, Any]:
    """Return the metadata of a snapshot.

    Args:
        attributes: of the site, kept as text: Icechunk sorts the names of what it keeps as values.
        note: what the history says of it.
        key: identifies the commit if a lost connection leaves it in doubt.
    """
    text = encode_json(attributes)
    return {"attributes": text, "robots": note.num_robots, "cells": note.num_cells, "commit": key}


def tag(repository: Any, path: str | Path, name: str, version: str) -> None:
    """Name a version."""
    rule, hint = "must be made of letters, digits, '.', '_' and '-'", "give spring-survey, say"
    require(isinstance(name, str) and _NAME.fullmatch(name) is not None, "name", rule, repr(name), hint)
    snapshot = find(repository, path, version)
    require(
        name not in repository.list_tags(), "name", "must be new", f"{name!r}, which names a version", "choose another"
    )
    try:
        repository.create_tag(name, snapshot)
    except Exception as error:  # Icechunk never gives a tag's name again
        if "tag already exists" not in str(error):
            raise
        require(False, "name", "must be new", f"{name!r}, which named a version once", "choose another")


def rollback(repository: Any, path: str | Path, version: str) -> str:
    """Commit what an earlier version was, on top of it, and make that the newest one, in one step.

    Returns:
        The tag that keeps the version that was the newest; "" if it is the one to go back to.
    """
    import numpy as np

    snapshot, tip = find(repository, path, version), str(repository.lookup_branch("main"))
    if snapshot == tip:
        return ""
    kept = _new_name(repository.list_tags(), "before-rollback")
    then, now = attributes_of(repository, snapshot), attributes_of(repository, tip)
    number = now.get("num_commits", 0) + 1
    taken_back = [*now.get("rollbacks", []), [then.get("num_commits", 0), number]]
    attributes = {**then, "num_commits": number, "rollbacks": taken_back}
    branch = _new_name(repository.list_branches(), "rollback")
    repository.create_branch(branch, snapshot)
    try:
        session = repository.writable_session(branch)
        write_array(session.store, _LOG, np.array(taken_back), {})  # a commit has to change something
        text = f"rolled back to {snapshot}"
        made = session.commit(text, metadata=metadata_of(attributes, Note(text)))
        repository.create_tag(kept, tip)
        repository.reset_branch("main", made, from_snapshot_id=tip)
    finally:
        repository.delete_branch(branch)
    return kept


def _new_name(taken: set[str], stem: str) -> str:
    return next(name for name in (f"{stem}-{number}" for number in count(1)) if name not in taken)


def compact(repository: Any, keep: int, *, is_alone: bool) -> int:
    """Drop all versions but the newest `keep` and those with tags; return the bytes that became free.

    Args:
        repository: to compact.
        keep: versions, at least 1.
        is_alone: whether no other writer is at work; otherwise chunks of the last ten minutes stay.
    """
    require_count("keep", keep, "give 100, say")
    newest = [each.written_at for each in _merges(repository, branch="main", most=keep)]
    if not newest:
        return 0
    repository.expire_snapshots(min(newest))  # by the writers' clocks: of one that was wrong, rather too few
    now = datetime.now(timezone.utc)
    found = repository.garbage_collect(now if is_alone else now - _LONGEST_MERGE, **_FEW_AT_A_TIME)
    return int(found.bytes_deleted)


def _read_tags(repository: Any) -> dict[str, tuple[str, ...]]:
    """Return the names of tags by the snapshot that they name."""
    tags: dict[str, tuple[str, ...]] = {}
    for name in sorted(repository.list_tags()):
        snapshot = str(repository.lookup_tag(name))
        tags[snapshot] = (*tags.get(snapshot, ()), name)
    return tags


def _merges(repository: Any, *, branch: str, most: int | None = None) -> Iterator[Any]:
    """Yield the snapshots of a branch that hold a site, the newest first; the first of a repository is empty."""
    for number, snapshot in enumerate(repository.ancestry(branch=branch)):
        if "attributes" not in snapshot.metadata or number == most:
            return
        yield snapshot


def _describe(snapshot: Any, tags: dict[str, tuple[str, ...]]) -> Version:
    own = snapshot.metadata
    numbers = own.get("robots", 0), own.get("cells", 0)
    return Version(snapshot.id, snapshot.written_at, snapshot.message, tags.get(snapshot.id, ()), *numbers)
