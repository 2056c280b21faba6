"""The directive `{filters}`: cards with a picture of each filter, then their signatures and docstrings."""

from __future__ import annotations

import inspect

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from torchelev import filters

PICTURES = "../pictures/filters"  # from docs/reference


def card(name: str) -> str:
    """Return a filter's card: its picture, name and first sentence."""
    summary = (inspect.getdoc(filters.FILTERS[name]) or "").partition("\n")[0]
    head = f":::{{grid-item-card}} `{name}`\n:img-top: {PICTURES}/{name}.png\n:link: torchelev.filters.{name}\n"
    return f"{head}:link-type: any\n:class-card: filter\n\n{summary}\n:::\n"


def cards(names: list[str]) -> str:
    """Return a grid of the filters' cards in markdown."""
    return "::::{grid} 2 2 3 4\n:gutter: 2\n\n" + "\n".join(map(card, names)) + "\n::::\n"


class Filters(SphinxDirective):
    """The named filters."""

    required_arguments = 1
    optional_arguments = 40

    def run(self) -> list[nodes.Node]:
        """Return the cards and the documentation."""
        functions = "\n".join(f".. autofunction:: torchelev.filters.{name}\n" for name in self.arguments)
        text = f"{cards(self.arguments)}\n```{{eval-rst}}\n{functions}\n```\n"
        return self.parse_text_to_nodes(text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("filters", Filters)
    return {"parallel_read_safe": True}
