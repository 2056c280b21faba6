"""The README: its tables are those of the results."""

import re

import pytest

from docs.readme_tables import ROOT, with_tables


def test_tables_are_those_of_the_results():
    text = (ROOT / "README.md").read_text()
    assert with_tables(text) == text, "run python -m docs.readme_tables"


@pytest.mark.slow(10)
def test_its_python_runs_from_the_first_block_to_the_last():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    runnable = [block for block in blocks if "cuda" not in block]
    assert len(blocks) - len(runnable) == 1 and len(runnable) >= 6
    names: dict[str, object] = {}
    for block in runnable:
        exec(compile(block, "README.md", "exec"), names)
