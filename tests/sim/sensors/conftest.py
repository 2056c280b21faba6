"""The ways in which rays are traced."""

import pytest

from torchelev.sim.sensors import body_casting, tracing

PATHS = ["C++", "selects rays", "keeps all rays"]  # what a CPU does with and without a compiler, and what a GPU does


@pytest.fixture(params=PATHS)
def path(request, monkeypatch):
    if request.param != PATHS[0]:
        monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    if request.param == PATHS[2]:
        for module in (body_casting, tracing):
            monkeypatch.setattr(module, "can_select_rays", lambda device: False)
    return request.param
