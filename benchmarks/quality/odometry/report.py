"""The table of the odometry's errors."""

from __future__ import annotations

from typing import Any

from torchelev.app.results import markdown_table


def table(result: dict[str, Any]) -> str:
    """Tabulate the errors."""
    head = ["poses", "end point [m]", "map RMSE, fixed frame [m]", "map RMSE around the robot [cm]", "95 % [cm]"]
    rows = [
        [row["poses"], f"{row['end_error']:.2f}", f"{row['map_rmse']:.2f}", f"{100 * row['local_rmse']:.1f}",
         f"{100 * row['local_rmse_95']:.1f}"]
        for row in result["rows"]
    ]  # fmt: skip
    return markdown_table(head, rows)
