"""Docstrings in this library's style become what Sphinx reads."""

import pytest

pytest.importorskip("sphinx", reason="needs pip install -e '.[docs]'")
from docs.extensions.docstrings import to_rst


def test_code_equations_and_bars():
    text = (
        "Take |x| of `|y|` and *a.\n\n    h = |z|\n    k = 1\n\nThen:\n\n```python\nif a:\n    b\n```\nEnd.\n\n"
        "Args:\n    x: Long\n        line."
    )
    assert "\n".join(to_rst(text.split("\n"))) == (
        "Take \\|x| of `|y|` and \\*a.\n\n.. code-block:: text\n\n    h = |z|\n    k = 1\n\nThen:\n\n\n"
        ".. code-block:: python\n\n"
        "   if a:\n       b\n\nEnd.\n\nArgs:\n    x: Long\n        line."
    )
