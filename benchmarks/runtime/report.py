"""Tables of the C library's results."""

from __future__ import annotations

from typing import Any

from torchelev.app.results import markdown_table


def speed_table(result: dict[str, Any]) -> str:
    """Tabulate times and memory by what was run."""
    columns = ("p50", "p99", "wall", "memory")
    lines = [[name, *(f"{row[column]:.1f}" for column in columns)] for name, row in result["rows"].items()]
    return markdown_table(["run", "p50 [ms]", "p99 [ms]", "process [ms]", "memory [MB]"], lines)


def replay_table(result: dict[str, Any]) -> str:
    """Tabulate by scenes how many updates and scans there were, and how many differ."""
    columns = list(next(iter(result["rows"].values())))
    return markdown_table(
        ["scenes", *columns], [[name, *map(str, row.values())] for name, row in result["rows"].items()]
    )


def processors_table(result: dict[str, Any]) -> str:
    """Tabulate by layer how far the processors are apart."""
    lines = []
    for layer in next(iter(result["rows"].values())):
        rows = [row[layer] for row in result["rows"].values()]
        share = max(row["differing"] / row["of"] for row in rows)
        lines.append([layer, f"{max(row['largest'] for row in rows):.1e}", f"{100 * share:.1f}"])
    return markdown_table(["values", "largest difference / range", "values that differ [%]"], lines)
