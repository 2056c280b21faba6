"""The README and the pages of benchmarks: their tables are those of the results, and the README's code runs."""

import pytest
import yaml
from click.testing import CliRunner

from docs.readme_tables import PAGES, ROOT, TABLES, empty_tables, has_result, names_of_tables, with_tables
from tests.docs.markdown import code_blocks, run_blocks
from torchelev.app.cli import main

README = ROOT / "README.md"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_are_those_of_the_results(page):
    text = page.read_text()
    assert with_tables(text, PAGES[page]) == text, "run python -m docs.readme_tables"


def test_the_summary_and_the_pages_of_benchmarks_have_every_table_once():
    summary, *details = [ROOT / "docs/benchmarks.md", *sorted((ROOT / "docs/benchmarks").glob("*.md"))]
    names = {page: names_of_tables(page.read_text()) for page in (summary, *details)}
    assert sorted(name for page in names for name in names[page]) == sorted(TABLES)
    assert [name for name in TABLES if name.startswith("summary_")] == names[summary] and all(names.values())


def test_each_table_has_a_caption_and_each_page_its_commands():
    for page in sorted((ROOT / "docs/benchmarks").glob("*.md")):
        text = page.read_text()
        assert "**Rerun**: `" in text
        for name in names_of_tables(text):
            caption = text.split(f"<!-- {name} -->")[0].rstrip().split("\n\n")[-1]
            assert caption.endswith(".") and not caption.startswith(("#", "|", "<")), f"{page.name}: {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_table_is_empty_although_its_result_exists(page):
    left = [name for name in empty_tables(page.read_text()) if has_result(name)]
    assert not left, "run python -m docs.readme_tables"


def test_a_table_stays_empty_until_its_result_exists(tmp_path, monkeypatch):
    monkeypatch.setitem(TABLES, "loop", lambda: (tmp_path / "loop.json").read_text())
    empty = "<!-- loop -->\n<!-- end -->\n"
    assert empty_tables(empty) == ["loop"] and not has_result("loop") and with_tables(empty) == empty
    with pytest.raises(FileNotFoundError):
        with_tables("<!-- loop -->\nof a result that was removed\n<!-- end -->\n")
    (tmp_path / "loop.json").write_text("numbers")
    assert has_result("loop") and empty_tables(with_tables(empty)) == []


def test_writes_a_table_in_place_of_an_old_one():
    old = "<!-- loop -->\nold\n<!-- end -->\nkept\n<!-- other -->\n"
    new = with_tables(old)
    assert "p99" in new and "old" not in new and new.endswith("<!-- end -->\nkept\n<!-- other -->\n")
    assert "(../benchmarks/results/" in with_tables("<!-- speed_robots -->\n<!-- end -->", "../")


@pytest.mark.slow(10)
def test_its_python_runs_from_the_first_block_to_the_last(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in code_blocks(README.read_text()) if block.language == "python"]
    assert len(blocks) >= 3
    run_blocks(README, blocks)
    assert {path.name for path in tmp_path.iterdir()} == {"stairs.png"}


@pytest.mark.slow(40)
def test_its_commands_run_in_order(tmp_path, monkeypatch):
    """Those that end by themselves; `view` opens a page, and is tested elsewhere."""
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in code_blocks(README.read_text()) if block.language == "bash"]
    lines = [line.split("#")[0].split() for block in blocks for line in block.code.splitlines()]
    commands = [words[1:] for words in lines if words[:1] == ["torchelev"] and words[1] != "view"]
    assert [words[0] for words in commands] == ["demo", "map", "plan"]
    for words in commands:
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 0, f"torchelev {' '.join(words)}: {done.output}"
    assert {"drive.mcap", "map.npz", "map.png"} <= {path.name for path in tmp_path.iterdir()}


def test_it_is_short_and_cites_this_version():
    assert len(README.read_text().splitlines()) <= 180
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert f'\nversion = "{citation["version"]}"\n' in (ROOT / "pyproject.toml").read_text()
    assert citation["license"] == "MIT" and "2204.12876" in str(citation["references"])


def test_the_table_of_stacks_is_the_one_of_the_docs():
    def rows(text):
        return [line for line in text.splitlines() if line.startswith("|")]

    readme, install = (path.read_text() for path in (ROOT / "README.md", ROOT / "docs/install.md"))
    ours = rows(readme.split("## Does it fit?")[1].split("\n## ")[0])
    assert len(ours) > 10
    assert [row.replace("](docs/howto/", "](howto/") for row in ours] == rows(
        install.split("## Simulators and stacks")[1]
    )
