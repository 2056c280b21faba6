"""Markdown tables, turned and taken apart."""

from __future__ import annotations

import functools
from collections.abc import Callable

from torchelev.app.results import markdown_table


def rows_of(table: str) -> list[list[str]]:
    """Return the cells of a Markdown table, the head first."""
    head, _, *rows = [line[2:-2].split(" | ") for line in table.splitlines()]
    return [head, *rows]


def transposed(table: str) -> str:
    """Return a Markdown table with rows for columns."""
    head, *rows = [list(row) for row in zip(*rows_of(table), strict=True)]
    return markdown_table(head, rows)


def upright(make: Callable[[], str]) -> Callable[[], str]:
    """Return what makes a table with rows for columns."""
    return lambda: transposed(make())


def in_parts(make: Callable[[], str], *names: str) -> dict[str, Callable[[], str]]:
    """Return by its name what makes each of the tables that a function returns in one text; the last takes the rest."""

    def part(number: int) -> str:
        return make().split("\n\n", len(names) - 1)[number]

    return {name: functools.partial(part, number) for number, name in enumerate(names)}
