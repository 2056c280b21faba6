"""What the tests share: small configs, poses, clouds, random states, and how two states are compared."""

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings

from torchelev.compiled_update import graphs_of
from torchelev.ops import compiler

settings.register_profile(
    "torchelev",
    max_examples=15,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],  # shrinking seeds takes minutes and shows nothing
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("torchelev")


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def compile_with(monkeypatch):
    """Let emap.compile() use another backend of the compiler, with the guards of the real one."""

    def use(backend):
        monkeypatch.setattr(compiler, "inductor", backend)
        graphs_of.cache_clear()
        torch._dynamo.reset()

    yield use
    graphs_of.cache_clear()
    torch._dynamo.reset()
