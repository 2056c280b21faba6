"""The runner of the pages' code finds the blocks that count."""

import pytest

from tests.docs.markdown import code_blocks, links, run_blocks

PAGE = """
```python
a = 1
```
````{tab-item} B
```{code-block} python
:caption: c

b = a
```
````
  ```python
  c = b
  ```
````markdown
```python
hidden
```
````
<!-- not run: needs a robot -->

```python
drive()
```
```python
d = c
```
"""


def test_finds_the_blocks_their_lines_and_reasons():
    blocks = [block for block in code_blocks(PAGE) if block.language == "python"]
    assert [(block.code.strip(), block.not_run) for block in blocks] == [
        ("a = 1", None),
        ("b = a", None),
        ("c = b", None),
        ("drive()", "needs a robot"),
        ("d = c", None),
    ]
    lines = PAGE.split("\n")
    assert all(lines[block.line - 1].strip() == block.code.split("\n")[0].strip() for block in blocks)


def test_a_mark_counts_right_before_a_block_only():
    marked = "<!-- not run: no -->\nBut this one does:\n```python\nx = 1\n```"
    assert code_blocks(marked)[0].not_run is None


def test_blocks_share_their_names_and_errors_name_the_line(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```python\nx = 1\n```\n\n```python\ny = x\n1 / 0\n```\n")
    blocks = code_blocks(page.read_text())
    assert run_blocks(page, blocks[:1])["x"] == 1
    with pytest.raises(ZeroDivisionError) as error:
        run_blocks(page, blocks)
    assert error.traceback[-1].lineno == 6 and "page.md" in str(error.traceback[-1].path)


def test_finds_relative_links_outside_of_code():
    text = '[a](b.md#c) ![d](e.png "f") [g](https://h.i) [j](#k) `[l](m.md)`\n```python\n[n](o.md)\n```\n'
    text += ":link: p\n:link: r.md\n:link: s\n:link-type: ref\n"
    assert sorted(links(text + "```{include} ../Q.md\n```\n")) == ["../Q.md", "b.md", "e.png", "p.md", "r.md"]
