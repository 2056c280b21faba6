"""One commit, beside other writers: on top of theirs where tiles differ."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchelev.site.storage.interface import Overtaken
from torchelev.site.storage.site_header import Header
from torchelev.site.storage.versioned.history import attributes_of, is_in_history
from torchelev.site.storage.versioned.repository import StoreError, UncertainCommitError, import_icechunk, is_in_doubt

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
        StoreError: it cannot be stored.
        UncertainCommitError: the connection ended; the commit may be stored.
    """
    icechunk, base = import_icechunk(), str(session.snapshot_id)
    while True:
        try:
            return str(session.commit(text, metadata=make_metadata(header.attributes))), header
        except icechunk.ConflictError:
            if has_commit(repository, key):  # a repeated request met its own result
                return str(repository.lookup_branch("main")), header
        except icechunk.IcechunkError as error:
            raise (UncertainCommitError(path, error, key) if is_in_doubt(error) else StoreError(path, error)) from error
        tip = str(repository.lookup_branch("main"))
        if not is_in_history(repository, base, tip):
            raise Overtaken
        try:
            session.rebase(icechunk.ConflictDetector())
        except (icechunk.RebaseFailedError, icechunk.IcechunkError) as error:  # the latter after a rollback, too
            raise Overtaken from error
        base = str(session.snapshot_id)
        header = header.with_attributes(_on_top(attributes_of(repository, base), header.attributes))


def has_commit(repository: Any, key: str) -> bool:
    """Return whether a commit with this key is among the newest ones."""
    for number, snapshot in enumerate(repository.ancestry(branch="main")):
        if snapshot.metadata.get("commit") == key:
            return True
        if number == _RECENT:
            return False
    return False


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
