"""One commit, beside other writers: on top of theirs where tiles differ."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchelev.site.storage.interface import Overtaken
from torchelev.site.storage.site_header import Header
from torchelev.site.storage.versioned.history import attributes_of, is_in_history
from torchelev.site.storage.versioned.repository import (
    RefusedCommitError,
    UncertainCommitError,
    import_icechunk,
    is_in_doubt,
)

_RECENT = 1000  # commits among which one in doubt is looked for


def commit(
    repository: Any,
    session: Any,
    path: str | Path,
    header: Header,
    text: str,
    key: str,
    make_metadata: Callable[[Mapping[str, Any]], dict[str, Any]],
) -> tuple[str, Header]:
    """Commit a session, on top of what other writers have committed since it began, if they changed other tiles.

    Args:
        repository: that the session belongs to.
        session: with changes.
        path: for errors.
        header: with the attributes to store.
        text: the message.
        key: that the metadata hold, by which the commit is found again.
        make_metadata: returns the snapshot's metadata for attributes.

    Returns:
        The id of the snapshot, and the header as it was stored.

    Raises:
        Overtaken: others have changed the same tiles, or the version that the session began with was rolled back.
        RefusedCommitError: it cannot be stored.
        UncertainCommitError: the connection ended; the commit may be stored.
    """
    icechunk, base = import_icechunk(), str(session.snapshot_id)
    while True:
        try:
            return str(session.commit(text, metadata=make_metadata(header.attributes))), header
        except icechunk.ConflictError:
            stored = find_commit(repository, key)
            if stored:  # a repeated request met its own result, on top of which there may be others' by now
                return stored, header
        except icechunk.IcechunkError as error:
            found = UncertainCommitError(path, error, key) if is_in_doubt(error) else RefusedCommitError(path, error)
            raise found from error
        tip = str(repository.lookup_branch("main"))
        if not is_in_history(repository, base, tip):
            raise Overtaken
        try:
            session.rebase(icechunk.ConflictDetector())
        except (icechunk.RebaseFailedError, icechunk.IcechunkError) as error:  # the latter after a rollback, too
            raise Overtaken from error
        base = str(session.snapshot_id)
        header = header.with_attributes(_on_top(attributes_of(repository, base), header.attributes))


def find_commit(repository: Any, key: str) -> str:
    """Return the id of the commit with this key among the newest ones; "" if there is none."""
    recent = itertools.islice(repository.ancestry(branch="main"), _RECENT)
    return next((str(snapshot.id) for snapshot in recent if snapshot.metadata.get("commit") == key), "")


def _on_top(theirs: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a commit that follows another writer's; Overtaken if they exclude each other."""
    joined = dict(own)
    if "num_commits" in theirs and "num_commits" in own:
        joined["num_commits"] = theirs["num_commits"] + 1
        joined["time"] = max(theirs["time"], own["time"])
    changes = {name for name in {*theirs, *own} if theirs.get(name) != joined.get(name)}
    if changes - {"num_commits", "time"}:  # such as the epoch, from which times count
        raise Overtaken
    return joined
