"""What the tests of the speed benchmarks share."""

import pytest

from torchelev import ElevationMap


@pytest.fixture
def eager(monkeypatch):
    """Skip compiling, which takes half a minute."""
    monkeypatch.setattr(ElevationMap, "compile", lambda self: None)
