"""An S3-compatible server on this machine, moto's, and a network to it that ends."""

import http.client
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

KEYS = {"AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any", "AWS_REGION": "us-east-1"}


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextmanager
def serve():
    """Yield the port of a server with the bucket `bucket`."""
    import boto3

    port = free_port()
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        for _ in range(300):
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                time.sleep(0.1)
        keys = {"aws_access_key_id": "any", "aws_secret_access_key": "any", "region_name": "us-east-1"}
        boto3.client("s3", endpoint_url=f"http://127.0.0.1:{port}", **keys).create_bucket(Bucket="bucket")
        yield port
    finally:
        server.kill()
        server.wait()


class Network(ThreadingHTTPServer):
    """The way to a server, which loses answers from when a request to a path that holds `lose_at` has arrived there.

    Args:
        target: port of the server.
        lose_at: part of a path.
        answers: that are lost; None: all from then on, in place of which errors come: they do not make Icechunk wait.
    """

    daemon_threads = True

    def __init__(self, target, lose_at, answers=None):
        super().__init__(("127.0.0.1", 0), _Forward)
        self.target, self.lose_at, self.answers, self.is_down, self.lost = target, lose_at, answers, False, 0
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def loses(self, method, path):
        if method != "PUT" or not self.lose_at or self.lose_at not in path or self.lost == self.answers:
            return False
        self.lost += 1
        self.is_down = self.answers is None
        return True


class _Forward(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def _pass(self):
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.server.is_down:
            self._refuse()
            return
        connection = http.client.HTTPConnection("127.0.0.1", self.server.target, timeout=30)
        connection.request(self.command, self.path, body, dict(self.headers))
        answer = connection.getresponse()
        content = answer.read()
        if self.server.loses(self.command, self.path):
            self._refuse() if self.server.is_down else setattr(self, "close_connection", True)
            return
        self.send_response_only(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in ("content-length", "transfer-encoding", "connection"):
                self.send_header(name, value)
        self.send_header("Content-Length", answer.getheader("Content-Length") or str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _refuse(self):
        self.send_response_only(400)
        self.send_header("Content-Length", "0")
        self.end_headers()

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = _pass

    def log_message(self, *args):
        pass


def lead_to(monkeypatch, port):
    """Set the variables that lead to a server."""
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}.items():
        monkeypatch.setenv(name, value)
