"""The directive `{help-of}`: what `python -m MODULE ARGUMENTS --help` prints, from the program's own parser."""

from __future__ import annotations

import contextlib
import io
import os
import runpy
import sys
from unittest import mock

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

WIDTH = 88  # [characters] of a line


def help_text(module: str, *arguments: str) -> str:
    """Run a program with `--help` in this process and return what it prints."""
    argv, out = [module, *arguments, "--help"], io.StringIO()
    with mock.patch.object(sys, "argv", argv), mock.patch.dict(os.environ, COLUMNS=str(WIDTH), NO_COLOR="1"):
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    return out.getvalue().rstrip()


class HelpOf(SphinxDirective):
    """A program's help as a block of text."""

    required_arguments = 1
    optional_arguments = 9

    def run(self) -> list[nodes.Node]:
        """Return the block; a program that prints nothing is an error."""
        text = help_text(*self.arguments)
        if not text:
            raise self.error(f"python -m {' '.join(self.arguments)} --help prints nothing")
        return [nodes.literal_block(text, text, language="text")]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("help-of", HelpOf)
    return {"parallel_read_safe": False}
