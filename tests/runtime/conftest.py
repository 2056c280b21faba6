"""The C library, built once."""

import pytest

from torchelev.kernels.cpu_build import find_compiler
from torchelev.runtime.library import build_library


@pytest.fixture(scope="session")
def library():
    if find_compiler() is None:
        pytest.skip("needs a C++ compiler")
    return build_library()
