"""Help texts are those of the real parsers."""

import sys

import pytest

pytest.importorskip("sphinx", reason="needs pip install -e '.[docs]'")
from docs.extensions.help_texts import WIDTH, help_text


@pytest.mark.parametrize("arguments", [("torchelev", "map"), ("benchmarks.speed.run",)])
def test_prints_what_the_program_prints(arguments):
    argv = list(sys.argv)
    text = help_text(*arguments)
    assert text.lower().startswith("usage: python -m " + " ".join(arguments))
    assert "--help" in text and max(map(len, text.split("\n"))) <= WIDTH + 32
    assert sys.argv == argv
