"""The README: its tables are those of the results."""

from benchmarks.readme import ROOT, with_tables


def test_tables_are_those_of_the_results():
    text = (ROOT / "README.md").read_text()
    assert with_tables(text) == text, "run python -m benchmarks.readme"
