#!/usr/bin/env bash
# Icechunk 1.1.21 and 2.3.0: does StorageRetriesSettings(max_tries=1) end a request to a server that does not answer?
#
# A repository is made on moto's S3 server, behind a proxy on this machine. The proxy then closes each connection
# without an answer, as a network that ended does, and the tip of the branch is looked up, with max_tries=1.
# Expected: one request, and an error within a second, with both versions.
# Seen: 2.3.0 sends one request and raises at once. 1.1.21, the last one for Python 3.11, sends ten and raises after
# between 8 and 45 seconds: the setting has no effect. A loop that must not stand still that long needs a thread of its
# own for commits, or Python 3.12 and Icechunk 2.
#
# Exits 0 while that holds. Installs into a temporary folder, 2 x 250 MB; needs Python 3.12 or later.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/ask.py" <<'PYTHON'
import socket
import subprocess
import sys
import threading
import time
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import icechunk

icechunk.set_logs_filter("error")
with socket.socket() as free:
    free.bind(("127.0.0.1", 0))
    target = free.getsockname()[1]
server = subprocess.Popen(
    [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(target)],
    stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
)
for _ in range(100):
    try:
        socket.create_connection(("127.0.0.1", target), 1).close()
        break
    except OSError:
        time.sleep(0.1)


class Proxy(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    is_down, requests = False, 0

    def forward(self):
        if Proxy.is_down:
            Proxy.requests += 1
            self.close_connection = True
            return
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        connection = HTTPConnection("127.0.0.1", target, timeout=30)
        connection.request(self.command, self.path, body, dict(self.headers))
        answer = connection.getresponse()
        content = answer.read()
        self.send_response_only(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in ("content-length", "transfer-encoding", "connection"):
                self.send_header(name, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    do_GET = do_PUT = do_POST = do_DELETE = forward

    def log_message(self, *args):
        pass


try:
    setup = HTTPConnection("127.0.0.1", target)
    setup.request("PUT", "/bucket")
    setup.getresponse().read()
    proxy = ThreadingHTTPServer(("127.0.0.1", 0), Proxy)
    proxy.daemon_threads = True
    threading.Thread(target=proxy.serve_forever, daemon=True).start()
    storage = icechunk.s3_storage(
        bucket="bucket", prefix="site", region="us-east-1", endpoint_url=f"http://127.0.0.1:{proxy.server_port}",
        allow_http=True, force_path_style=True, access_key_id="any", secret_access_key="any",
    )
    once = icechunk.StorageRetriesSettings(max_tries=1, initial_backoff_ms=10, max_backoff_ms=50)
    config = icechunk.RepositoryConfig(storage=icechunk.StorageSettings(retries=once))
    repository = icechunk.Repository.create(storage, config)
    Proxy.is_down, start = True, time.monotonic()
    try:
        repository.lookup_branch("main")
        error = "none"
    except icechunk.IcechunkError as raised:
        error = type(raised).__name__
    seconds = time.monotonic() - start
    print(f"{icechunk.__version__}: {Proxy.requests} requests, {seconds:.2f} s, error {error}")
    is_once = Proxy.requests == 1 and seconds < 2.0
    sys.exit(is_once != (sys.argv[1] == "once"))
finally:
    server.kill()
PYTHON
for each in "1.1.21 often" "2.3.0 once"; do
    read -r version times <<< "$each"
    "${PYTHON:-python3.12}" -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet --disable-pip-version-check "icechunk==$version" "moto[server]==5.1.18"
    "$folder/$version/bin/python" "$folder/ask.py" "$times" || { echo changed; exit 1; }
done
echo "as before"
