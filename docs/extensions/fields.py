"""The directive `{fields}`: a table of a config's or NamedTuple's fields, from their `#:` comments.

    ```{fields} torchelev.GridConfig
    resolution: Raise it for speed.
    ```

Its body may say a sentence about each field, `name: text`, for the last column; then it must do so for all fields, so
that a new field cannot be forgotten. The option `:heads:` names the columns. The site's search and index find each
row by the name of its field, and {field}`GridConfig.resolution` links to it.
"""

from __future__ import annotations

import dataclasses
import inspect
import pydoc
import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import make_id

UNIT = re.compile(r"^\[([^\]]+)\] ?")


def comments(cls: type) -> dict[str, str]:
    """Return the `#:` comment of each field of a class, in their order."""
    docs = ModuleAnalyzer.for_module(cls.__module__).find_attr_docs()
    return {name: " ".join(" ".join(lines).split()) for (owner, name), lines in docs.items() if owner == cls.__name__}


def read_notes(text: str) -> dict[str, str]:
    """Return the sentence about each field from a directive's body; indented lines continue one."""
    entries = re.findall(r"^(\w+):\s+(.*(?:\n[ \t]+.*)*)", text, re.MULTILINE)
    return {name: " ".join(note.split()) for name, note in entries}


def table(cls: type, heads: list[str], notes: dict[str, str]) -> str:
    """Return the table of a class's fields in markdown."""
    lines = [heads, ["---"] * len(heads), *_rows(cls, notes)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _rows(cls: type, notes: dict[str, str]) -> Iterator[list[str]]:
    defaults = _defaults(cls)
    for name, comment in comments(cls).items():
        unit = UNIT.match(comment)
        cells = [f"`{name}`"]
        if defaults:
            cells.append(_with_unit(defaults[name], unit and unit[1]))
            comment = UNIT.sub("", comment)
        cells.append(_sentence(comment))
        yield [cell.replace("|", "\\|") for cell in (*cells, *([notes[name]] if notes else []))]


def _defaults(cls: type) -> dict[str, str]:
    """Return the default of each setting as text; nothing for a NamedTuple."""
    if not dataclasses.is_dataclass(cls):
        return {}
    return {field.name: _default(field) for field in dataclasses.fields(cls)}


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default_factory is not dataclasses.MISSING:
        return f"`{getattr(field.default_factory, '__name__', '...')}()`"
    if field.default is dataclasses.MISSING:
        return "required"
    name = type(field.default).__name__
    return f"`{name}()`" if dataclasses.is_dataclass(field.default) else f"`{field.default!r}`"


def _with_unit(default: str, unit: str | None) -> str:
    comma = "," if default == "required" else ""
    return f"{default}{comma} {unit.replace('^2', '²')}" if unit else default


def _sentence(comment: str) -> str:
    """Return a comment with its first letter raised, unless it is code, a symbol or nothing."""
    return comment[:1].upper() + comment[1:] if re.match(r"[a-z]{2,}[ ,:;]", comment) else comment


class Fields(SphinxDirective):
    """The table of a class's fields."""

    required_arguments = 1
    has_content = True
    option_spec = {"heads": directives.unchanged}

    def run(self) -> list[nodes.Element]:
        """Return the table; a field without a sentence, or one that is gone, is an error."""
        cls = pydoc.locate(self.arguments[0])
        if not inspect.isclass(cls):
            raise self.error(f"{self.arguments[0]} is not a class")
        self.env.note_dependency(inspect.getfile(cls))
        notes = read_notes("\n".join(self.content))
        if notes and set(notes) != set(comments(cls)):
            raise self.error(f"{cls.__name__}: say a sentence about each of {sorted(set(notes) ^ set(comments(cls)))}")
        parsed = self.parse_text_to_nodes(table(cls, self._heads(cls, bool(notes)), notes))
        for node in parsed:
            node["classes"].append("fields")
        rows = [row for node in parsed for body in node.findall(nodes.tbody) for row in body]
        return [*map(self._target, comments(cls), rows), *parsed]

    def _target(self, field: str, row: nodes.Element) -> addnodes.index:
        """Make a row the target of its field, and return its entry in the index."""
        owner = self.arguments[0].rpartition(".")[2]
        target = make_id(self.env, self.state.document, "", f"{owner}.{field}")
        row["ids"].append(target)
        self.env.domains.standard_domain.note_object("field", f"{owner}.{field}", target, location=row)
        return addnodes.index(entries=[("single", f"{field} ({owner})", target, "", None)])

    def _heads(self, cls: type, noted: bool) -> list[str]:
        if "heads" in self.options:
            return [head.strip() for head in self.options["heads"].split(",")]
        setting = ["Setting", "Default", "Meaning"] if dataclasses.is_dataclass(cls) else ["Field", "Meaning"]
        return [*setting, *(["When to change it"] if noted else [])]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("fields", Fields)
    app.add_object_type("field", "field", objname="field")
    return {"parallel_read_safe": True}
