"""A free port; without viser, no test of the live view."""

import importlib.util
import socket

import pytest

collect_ignore_glob = [] if importlib.util.find_spec("viser") else ["test_*.py"]


@pytest.fixture
def port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
