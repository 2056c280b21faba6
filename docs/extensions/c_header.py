"""The directive `{c-header}`: a C header as a reference, from its comments in `/** ... */`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_SECTION = re.compile(r"/\* ([\w ]+?) -+ \*/")
_ENTRY = re.compile(r"/\*\*\s(.*?)\*/\s*\n((?:typedef [^;{]*;|typedef [^{]*\{.*?\}[^;]*;|[\w][^;{]*;))", re.DOTALL)


class Entry(NamedTuple):
    """A declaration and what its comment says."""

    declaration: str
    paragraphs: list[str]
    parameters: list[tuple[str, str]]  #: name and meaning


def sections(text: str) -> Iterator[tuple[str, list[Entry]]]:
    """Yield the sections of a header by title, with their entries; the first one holds the types."""
    body = text[text.index('extern "C" {') :]
    parts = _SECTION.split(body)
    titles = ["Types and errors", *parts[1::2]]
    for title, part in zip(titles, parts[::2], strict=True):
        yield title, [_entry(*found.groups()) for found in _ENTRY.finditer(part)]


def _entry(comment: str, declaration: str) -> Entry:
    lines = [re.sub(r"^\s*\* ?", "", line).rstrip() for line in comment.strip().splitlines()]
    text, *rest = re.split(r"^@param ", "\n".join(lines), flags=re.MULTILINE)
    parameters = [(name, " ".join(meaning.split())) for name, _, meaning in (part.partition(" ") for part in rest)]
    return Entry(declaration, [" ".join(p.split()) for p in text.split("\n\n") if p.strip()], parameters)


class CHeader(SphinxDirective):
    """The entries of a header, seen from the repository."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return a section for each of the header's."""
        path = Path(self.env.srcdir).parent / self.arguments[0]
        self.env.note_dependency(str(path))
        return [self._section(title, entries) for title, entries in sections(path.read_text())]

    def _section(self, title: str, entries: list[Entry]) -> nodes.Node:
        section = nodes.section(ids=[nodes.make_id(title)])
        section += nodes.title(title, title)
        for entry in entries:
            section += nodes.literal_block(entry.declaration, entry.declaration, language="c")
            section += [_paragraph(text) for text in entry.paragraphs]
            if entry.parameters:
                section += _list(entry.parameters)
        return section


def _paragraph(text: str) -> nodes.paragraph:
    paragraph = nodes.paragraph()
    for k, part in enumerate(text.split("`")):
        paragraph += nodes.literal(part, part) if k % 2 else nodes.Text(part)
    return paragraph


def _list(parameters: list[tuple[str, str]]) -> nodes.bullet_list:
    items = nodes.bullet_list()
    for name, meaning in parameters:
        items += nodes.list_item("", _paragraph(f"`{name}`: {meaning}"))
    return items


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("c-header", CHeader)
    return {"parallel_read_safe": True}
