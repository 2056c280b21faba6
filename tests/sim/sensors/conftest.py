"""The two ways in which rays are traced."""

import pytest

from torchelev.sim.sensors import tracing

PATHS = ["selects rays", "keeps all rays"]  # what a CPU does, and what a GPU does


@pytest.fixture(params=PATHS)
def path(request, monkeypatch):
    if request.param == PATHS[1]:
        monkeypatch.setattr(tracing, "can_select_rays", lambda device: False)
    return request.param
