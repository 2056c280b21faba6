"""A page on a free port."""

import socket

import pytest

pytest.importorskip("viser", reason="needs torchelev[view]")


@pytest.fixture
def port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
