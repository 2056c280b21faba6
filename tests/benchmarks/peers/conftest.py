"""What tests of peers share."""

import sys
from pathlib import Path

import pytest


@pytest.fixture
def cell_means(tmp_path):
    """Return the path of a program that answers with the mean of each cell."""
    path = tmp_path / "cell_means"
    path.write_text(f"#!{sys.executable}\n" + Path(__file__).with_name("cell_means.py").read_text())
    path.chmod(0o755)
    return path
