"""The python of every page runs, from its first block to its last."""

import pytest

from tests.docs.markdown import DOCS, code_blocks, pages, run_blocks

PAGES = {
    str(path.relative_to(DOCS)): [b for b in code_blocks(path.read_text()) if b.language == "python"]
    for path in pages()
}
ELSEWHERE = "howto/export.md"  #: which test_export.py runs, for half a minute
COLUMNS = 88  #: of code that the site shows without scrolling


@pytest.mark.slow(10)
@pytest.mark.parametrize("page", [page for page, blocks in PAGES.items() if blocks and page != ELSEWHERE])
def test_its_python_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    run_blocks(DOCS / page, [block for block in PAGES[page] if block.not_run is None])


@pytest.mark.parametrize("page", PAGES)
def test_says_why_a_block_does_not_run(page):
    assert all(block.not_run != "" for block in PAGES[page]), "write <!-- not run: REASON -->"


@pytest.mark.parametrize("page", PAGES)
def test_its_code_fits_into_the_columns_of_the_site(page):
    blocks = [
        block
        for block in code_blocks((DOCS / page).read_text())
        if block.language != "text" and "{" not in block.language
    ]
    lines = [(block.line + k, line) for block in blocks for k, line in enumerate(block.code.split("\n"))]
    long = [f"{page}:{number}: {line}" for number, line in lines if len(line) > COLUMNS]
    assert not long, f"expected at most {COLUMNS} columns, got\n" + "\n".join(long)
