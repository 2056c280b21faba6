"""Tabulate the results, which needs no Isaac Lab."""

from __future__ import annotations

from typing import Any

from torchelev.app.results import markdown_table

#: the terms by what they measure with
SENSORS = {
    "camera": "ray-cast camera, 64 x 48",
    "rendered": "the same, rendered",
    "slow": "the same, at every second step",
    "lidar": "lidar, 24 x 90 rays",
    "both": "camera and lidar",
}


def table(results: dict[str, Any]) -> str:
    """Tabulate the differences [mm] and the times of a step [ms], with the versions."""
    rows = []
    for name, label in SENSORS.items():
        found = results["error"][name]
        parts = [(found["all"], "p50"), (found["all"], "p90"), (found["level"], "p90"), (found["level"], "p99")]
        rows.append([label, f"{found['valid']:.0%}", *(f"{1e3 * part[key]:.2f}" for part, key in parts)])
    head = ["map of", "points known", "median mm", "p90 mm", "p90 mm, level ground", "p99 mm, level ground"]
    times, versions = results["milliseconds_per_step"], results["versions"]
    steps = (
        f"A control step of {results['num_envs']} robots takes {times['neither']:.0f} ms without a scan, "
        f"{times['ideal scan']:.0f} ms with the ideal scan, {times['camera']:.0f} ms with the camera alone and "
        f"{times['map']:.0f} ms with its map"
    )
    return f"{markdown_table(head, rows)}\n\n{steps}. {', '.join(f'{name} {v}' for name, v in versions.items())}."
