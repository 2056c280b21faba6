"""Write the tables of the README and of the pages from the results, so that every number comes from a run.

    python -m docs.readme_tables

Each table is between <!-- name --> and <!-- end -->. docs/benchmarks.md, the summary, and the pages of docs/benchmarks/
together hold every table once, the README and the other pages a selection. A table whose result does not exist yet
stays empty, and its name is printed.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

from docs.result_tables import TABLES

ROOT = Path(__file__).parents[1]


def with_tables(text: str, to_root: str = "") -> str:
    """Return a page's text with new tables.

    Args:
        text: the page.
        to_root: path from the page to the root, from which the pictures in the tables count.
    """
    for name in names_of_tables(text):
        if name in empty_tables(text) and not has_result(name):
            continue
        table = TABLES[name]().replace("](", f"]({to_root}")
        pattern = rf"(<!-- {name} -->\n).*?(<!-- end -->)"
        text = re.sub(pattern, functools.partial(_insert, table), text, flags=re.DOTALL)
    return text


def names_of_tables(text: str) -> list[str]:
    """Return the names of the tables that a page holds, in its order."""
    return [name for name in re.findall(r"<!-- (\w+) -->\n", text) if name in TABLES]


def empty_tables(text: str) -> list[str]:
    """Return the names of the tables of a page that have no content."""
    return [name for name in names_of_tables(text) if re.search(rf"<!-- {name} -->\n\s*<!-- end -->", text)]


def has_result(name: str) -> bool:
    """Return whether the results that a table needs exist."""
    try:
        TABLES[name]()
    except FileNotFoundError:
        return False
    return True


def _insert(table: str, match: re.Match[str]) -> str:
    return f"{match[1]}{table}\n{match[2]}"


def find_pages() -> dict[Path, str]:
    """Return the README and the pages that hold tables, with the path from each to the root."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    depths = {page: len(page.relative_to(ROOT).parts) - 1 for page in pages if names_of_tables(page.read_text())}
    return {page: "../" * depth for page, depth in depths.items()}


PAGES = find_pages()

if __name__ == "__main__":
    for page, to_root in PAGES.items():
        page.write_text(with_tables(page.read_text(), to_root))
        for name in empty_tables(page.read_text()):
            print(f"{page.relative_to(ROOT)}: {name} stays empty, as its result does not exist yet")
