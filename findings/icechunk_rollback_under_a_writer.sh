#!/usr/bin/env bash
# Icechunk 2.3.0: what does a writer get whose branch was rolled back, or compacted, while its session was open?
#
# Three commits to an array of four chunks. A writer opens a session and writes chunk 2, which no commit touches again.
# Before it commits, rebasing with ConflictDetector, another process (a) commits chunk 1, (b) moves main one commit back
# with reset_branch, as to undo a bad one, or (c) commits chunk 1 and then expires the older snapshots.
# Expected: (a) succeeds. (b) and (c), if they do not succeed, raise ConflictError or RebaseFailedError, the errors that
# tell a writer to begin again from the newest snapshot.
# Seen: (a) succeeds. (b) and (c) raise InternalError: "error finding conflicting path for node ..., this probably
# indicades a bug in `rebase`", an error that is neither of the two. What is stored stays right. Whoever rolls back or
# expires beside writers should catch IcechunkError, look whether the session's snapshot is still in the branch's
# ancestry, and write again in a new session if it is not.
#
# Exits 0 while that holds. Installs into a temporary folder, 150 MB; needs Python 3.12 or later.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.12}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check icechunk==2.3.0 zarr==3.4.2
"$folder/venv/bin/python" - <<'PYTHON'
import sys
from datetime import datetime, timezone

import icechunk
import numpy as np
import zarr

icechunk.set_logs_filter("error")


def write(repository, chunk, value):
    session = repository.writable_session("main")
    zarr.open_array(session.store, path="cells")[64 * chunk : 64 * (chunk + 1)] = value
    return session


def commit_another(repository):
    write(repository, 1, 5.0).commit("chunk 1")


def roll_back(repository):
    repository.reset_branch("main", [each.id for each in repository.ancestry(branch="main")][1])


def commit_and_expire(repository):
    commit_another(repository)
    repository.expire_snapshots(datetime.now(timezone.utc))


def commit_after(disturb):
    """Return the name of the error that a commit raises, and the array's chunks after it."""
    repository = icechunk.Repository.create(icechunk.in_memory_storage())
    session = repository.writable_session("main")
    zarr.create_array(session.store, name="cells", data=np.ones(256, np.float32), chunks=(64,))
    session.commit("new")
    for value in (2.0, 3.0):
        write(repository, 0, value).commit(f"chunk 0 is {value:g}")
    session, error = write(repository, 2, 7.0), "none"
    disturb(repository)
    try:
        session.commit("chunk 2", rebase_with=icechunk.ConflictDetector())
    except icechunk.IcechunkError as raised:
        error = type(raised).__name__
        print("  ", str(raised).splitlines()[0])
        assert not isinstance(raised, (icechunk.ConflictError, icechunk.RebaseFailedError))
    array = zarr.open_array(repository.readonly_session("main").store, path="cells", mode="r")
    return error, array[::64].tolist()


seen = {disturb.__name__: commit_after(disturb) for disturb in (commit_another, roll_back, commit_and_expire)}
for name, (error, chunks) in seen.items():
    print(f"{name}: error {error}, chunks {chunks}")
holds = seen == {
    "commit_another": ("none", [3.0, 5.0, 7.0, 1.0]),
    "roll_back": ("InternalError", [2.0, 1.0, 1.0, 1.0]),
    "commit_and_expire": ("InternalError", [3.0, 5.0, 1.0, 1.0]),
}
print("as before" if holds else "changed")
sys.exit(not holds)
PYTHON
