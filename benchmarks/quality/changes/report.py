"""The tables of new obstacles, plates and ghosts."""

from __future__ import annotations

from typing import Any

from benchmarks.quality.changes import obstacles
from torchelev.app.results import markdown_table


def tables(result: dict[str, Any]) -> str:
    """Tabulate obstacles, plates and ghosts."""

    def scans(row: dict[str, Any]) -> list[str]:
        limit = obstacles.WATCHED
        return [str(row[k]) if row[k] <= limit else f"> {limit}" for k in ("median", "most")]

    new = [[name, f"{row['points']:.1f}", *scans(row)] for name, row in result["obstacles"].items()]
    plates = [[name, f"{row['rmse_mm']:.2f}", *scans(row)] for name, row in result["plates"].items()]
    columns = ("seen_through", "environments_seen_through", "cells", "environments", "of")
    left = [[name, *(str(row[column]) for column in columns)] for name, row in result["ghosts"].items()]
    return "\n\n".join(
        [
            markdown_table(["obstacle", "points a cell", "scans to half, median", "most"], new),
            markdown_table(["aging [m²/s]", "error before [mm]", "scans to 80 %, median", "most"], plates),
            markdown_table(
                ["sensor", "cells left, seen through", "robots with such", "cells left", "robots with any", "robots"],
                left,
            ),
        ]
    )
