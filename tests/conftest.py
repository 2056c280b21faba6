"""What all tests share: hypothesis' profile, one thread, and how workers share the tests."""

import collections
import contextlib
import signal
import socket

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings

import envs.offscreen  # noqa: F401  (before any test imports MuJoCo)
from torchelev import ElevationMapConfig, pipeline
from torchelev.kernels.cpu_update import is_built
from torchelev.runtime.library import build_library

settings.register_profile(
    "torchelev",
    max_examples=15,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],  # shrinking seeds takes minutes and shows nothing
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("torchelev")
# A script's background jobs ignore Ctrl-C, and so would the programs that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_sessionstart(session):
    """Build the C++ of updates and the C library once, on all cores, before each of xdist's workers would do it."""
    if getattr(session.config.option, "numprocesses", None) and not hasattr(session.config, "workerinput"):
        is_built(pipeline.register_stages(ElevationMapConfig()))
        with contextlib.suppress(RuntimeError):  # without a compiler
            build_library()


def pytest_collection_modifyitems(config, items):
    """Skip what this torch cannot compile; let xdist's workers begin with the slowest files, to end together."""
    seconds = collections.Counter()
    for item in items:
        if item.get_closest_marker("compiles") and torch.__version__ < "2.10":
            item.add_marker(pytest.mark.skip(reason="compiled updates need torch 2.10 or later"))
        slow = item.get_closest_marker("slow")
        seconds[item.path] += slow.args[0] if slow else 0
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: -seconds[item.path])


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def figures(monkeypatch):
    """The figures that are written to files, in their order."""
    from matplotlib.figure import Figure

    written, save = [], Figure.savefig

    def note(figure, *args, **kwargs):
        if figure not in written:
            written.append(figure)
        save(figure, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", note)
    return written


@pytest.fixture
def port():
    """A port that is free."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
