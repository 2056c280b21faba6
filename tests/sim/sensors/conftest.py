"""The ways in which rays are traced."""

import pytest

from tests.devices import never_wait

PATHS = ["C++", "selects rays", "keeps all rays"]  # what a CPU does with and without a compiler, and what a GPU does


@pytest.fixture(params=PATHS)
def path(request, monkeypatch):
    if request.param != PATHS[0]:
        monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    if request.param == PATHS[2]:
        never_wait(monkeypatch)
    return request.param
