"""Every page is in a table of contents, and what it links to exists."""

import re

import pytest

from tests.docs.markdown import DOCS, links, pages

PAGES = pages()


def listed(page):
    """The pages that a page's tables of contents name."""
    entries = "\n".join(re.findall(r"\{toctree\}\n(.*?)\n(?:`{3,}|:{3,})$", page.read_text(), re.DOTALL | re.MULTILINE))
    names = [re.sub(r".*<(.*)>", r"\1", line.strip()) for line in entries.split("\n")]
    return [(page.parent / f"{name.removesuffix('.md')}.md").resolve() for name in names if name and name[0] != ":"]


def test_every_page_is_in_one_table_of_contents():
    entries = [entry for page in PAGES for entry in listed(page) if entry.parent.name != "notebooks"]
    assert sorted(entries) == sorted(page.resolve() for page in PAGES if page != DOCS / "index.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_what_it_links_to_exists(page):
    missing = [target for target in links(page.read_text()) if not (page.parent / target).exists()]
    assert not missing
