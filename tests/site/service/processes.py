"""A merger in a process of its own, which can end at chosen places, and a network that can be cut."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading

from tests.processes import ROOT

#: A merger on a port; DIE is where the process kills itself, at the n-th merge.
SCRIPT = """
import os, signal, sys
import torch
torch.set_num_threads(1)
from torchelev.site.service import NetworkedServer, SiteServer
from torchelev.site.storage import store

path, port, place, number, engine = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]), sys.argv[5]
merges = 0

def die(at):
    if at == place and merges == number:
        os.kill(os.getpid(), signal.SIGKILL)

with_files = store.finish
def finish(folder):  # the commit is on disk, its files are not in place
    die("committed")
    return with_files(folder)
store.finish = finish

server = SiteServer(path, resolution=0.1, align=False, engine=engine)
write = server.site._write
def write_and_count(parts, *arguments, **options):
    global merges
    merges += 1
    def some():
        for part in parts:
            yield part
            die("writing")
    result = write(some(), *arguments, **options)
    die("before the answer")
    return result
server.site._write = write_and_count
with NetworkedServer(server, listen=f"tcp/127.0.0.1:{port}") as network:
    print("ready", flush=True)
    network.run(lambda: False)
"""


class MergerProcess:
    """A merger that runs until it is stopped, or ends by itself."""

    def __init__(self, path, port, place="nowhere", number=0, engine="files"):
        env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"}
        arguments = [sys.executable, "-c", SCRIPT, str(path), str(port), place, str(number), engine]
        self._process = subprocess.Popen(arguments, env=env, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout.readline() == "ready\n"

    def wait(self, timeout=30.0):
        return self._process.wait(timeout)

    def signal(self, number):
        self._process.send_signal(number)

    def stop(self):
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        self._process.wait()
        self._process.stdout.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()


class Cable:
    """Forwards a port to another one, until it is pulled: connections end, and new ones are refused."""

    def __init__(self, target):
        self._target, self._sockets, self.is_pulled = target, [], False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if self.is_pulled:
                    near.close()
                    continue
                with contextlib.suppress(OSError):
                    far = socket.create_connection(("127.0.0.1", self._target))
                    self._sockets += [near, far]
                    for pair in ((near, far), (far, near)):
                        threading.Thread(target=self._forward, args=pair, daemon=True).start()

    def _forward(self, source, sink):
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                sink.sendall(data)
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def pull(self):
        self.is_pulled = True
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self._sockets = []

    def plug_in(self):
        self.is_pulled = False

    def close(self):
        self.pull()
        self._listener.close()


KILLED = -signal.SIGKILL
