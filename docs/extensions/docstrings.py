"""Docstrings as this library writes them, made readable for Sphinx.

Code stands in ``` fences, and an equation is a block of lines indented by four. Bars are absolute values.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

_FENCE = re.compile(r"^(\s*)```(\w*)$")
_CODE = re.compile(r"(`+[^`]+`+)")


def to_rst(lines: list[str]) -> list[str]:
    """Return the lines of a docstring with code and equations as literal blocks and bars escaped."""
    result: list[str] = []
    inside, equation = False, -1  # of a fence, and the indent of an equation
    for number, line in enumerate(lines):
        fence, indent = _FENCE.match(line), _indent(line)
        if line.strip() and indent < equation:
            equation = -1
        if fence:
            result += [""] if inside else ["", f"{fence[1]}.. code-block:: {fence[2] or 'text'}", ""]
            inside = not inside
        elif inside:
            result.append(f"   {line}".rstrip())
        elif equation < 0 and _starts_equation(lines, number):
            equation = indent
            result += [f"{' ' * (indent - 4)}.. code-block:: text", "", line]
        else:
            result.append(line if equation >= 0 else _escape(line))
    return result


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _starts_equation(lines: list[str], number: int) -> bool:
    """Return whether a line follows a blank one and is indented by four more than the text before it."""
    if number < 2 or not lines[number].strip() or lines[number - 1].strip():
        return False
    return _indent(lines[number]) == _indent(lines[number - 2]) + 4


def _escape(line: str) -> str:
    """Escape what reStructuredText would read as markup, outside of code."""
    parts = _CODE.split(line)
    return "".join(part if part.startswith("`") else re.sub(r"([|*])(?=[\w(])", r"\\\1", part) for part in parts)


def _process(app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    # Napoleon takes what stands before a colon in an attribute's first line for its type, so that line is left empty.
    lines[:] = [*([""] if what == "attribute" else []), *to_rst(lines)]


def setup(app: Sphinx) -> dict[str, bool]:
    """Change docstrings before napoleon reads them."""
    app.connect("autodoc-process-docstring", _process, priority=100)
    return {"parallel_read_safe": True}
