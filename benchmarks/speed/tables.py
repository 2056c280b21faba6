"""Tables of a speed result, and which of its targets are met."""

from __future__ import annotations

from typing import Any

from benchmarks.speed.workload import BPEARL, SENSORS
from torchelev.app.results import markdown_table

TARGETS = {6276: 2.5, 43074: 6.0, 407040: 20.0}  # [ms] one robot
EAGER = 4  # times TARGETS, of updates that are not compiled
MANY = 45.0  # [ms] 256 robots
FLAT = 1.15  # the time per robot may not rise by more, from 256 robots on
MEMORY = 1.5  # times what state, points and polar table need on paper
SHARE = 0.15  # of an update: reset, recenter, sample
GROWTH = {"points": 1.0, "cells": 1.1, "rays": 0.1}  # exponents, the last in absolute value


def by(rows: list[dict[str, Any]], key: str) -> dict[Any, dict[str, Any]]:
    """Index rows by one of their fields."""
    return {row[key]: row for row in rows}


def verdicts(result: dict[str, Any]) -> str:
    """Tabulate what was aimed at: case, figure, target, and whether it is met."""
    rows = []

    def check(case: str, value: float, limit: float, form: str, remark: str = "") -> None:
        verdict = "met" if value <= limit else "missed"
        rows.append([case, form.format(value) + remark, "<= " + form.format(limit), verdict])

    if "points" in result:
        full, eager = (by(result["points"][kind], "points") for kind in ("full", "eager"))
        for n, limit in TARGETS.items():
            check(f"one robot, {n:,} points", full[n]["median"], limit, "{:.1f} ms")
        for n, row in eager.items():
            remark = f", {row['median'] / full[n]['median']:.1f} x compiled"
            check(f"eager, {n:,} points", row["median"], EAGER * TARGETS[n], "{:.1f} ms", remark)
        check("growth with points", result["points"]["exponent_from_43074"], GROWTH["points"], "exponent {:.2f}")
        check("graphs compiled for 8 numbers of points (for one: 3)", result["points"]["graphs"], 3, "{:.0f}")
    if "robots" in result:
        many = by(result["robots"]["rows"], "robots")
        check("256 robots x 512 points", many[256]["median"], MANY, "{:.1f} ms")
        flat = max(many[n]["ms_per_robot"] for n in many if n > 256) / many[256]["ms_per_robot"]
        check("time per robot beyond 256", flat, FLAT, "{:.2f} x that at 256")
        most = max(row["bytes_per_robot"] for row in many.values()) / result["robots"]["needed_bytes_per_robot"]
        check("memory per robot, of any number", most, MEMORY, "{:.2f} x the need on paper")
    if "cells" in result:
        check("growth with cells", result["cells"]["exponent"], GROWTH["cells"], "exponent {:.2f}")
    if "rays" in result:
        check("growth with ray length", abs(result["rays"]["exponent"]), GROWTH["rays"], "exponent {:.2f}")
    for row in result["parts"]["rows"] if "parts" in result else []:
        for name, share in row["shares"].items():
            check(f"{name}, robots: {row['robots']}", 100 * share, 100 * SHARE, "{:.0f} % of an update")
    if "start" in result:
        check("import beyond torch", result["start"]["import_seconds"], 0.3, "{:.2f} s")
        check("first compiled update", result["start"]["first_update_seconds"], 60, "{:.0f} s")
    return markdown_table(["case", "measured", "target", ""], rows)


def sensors(result: dict[str, Any]) -> str:
    """Tabulate the update rate with the paper's sensors (paper, Table II)."""
    full, plain, eager = (by(result["points"][kind], "points") for kind in ("full", "baseline", "eager"))
    rows = []
    for name, n, paper, _ in SENSORS:
        times = [f"{kind[n]['median']:.1f} ({kind[n]['min']:.1f})" for kind in (full, plain, eager)]
        rows.append([name, f"{n:,}", *times, f"{1e3 / full[n]['median']:.0f}", f"{paper}"])
    kinds = [f"{kind}, ms (fastest)" for kind in ("all stages", "plain baseline", "eager")]
    head = ["the paper's sensor", "points", *kinds, "Hz", "the paper's Hz, Xavier GPU"]
    return markdown_table(head, rows)


def stages(result: dict[str, Any]) -> str:
    """Tabulate the stages (paper, Table I)."""
    rows = [[name, f"{t['median']:.2f}", f"{t['min']:.2f}"] for name, t in result["stages"]["stages"].items()]
    return markdown_table([f"stage alone, {BPEARL:,} points", "median ms", "min ms"], rows)


def robots(result: dict[str, Any]) -> str:
    """Tabulate time and memory by number of robots."""
    rows = []
    for row in result["robots"]["rows"]:
        memory = f"{row['bytes_per_robot'] / 1e3:.0f}"
        rows.append([f"{row['robots']:,}", f"{row['median']:.1f}", f"{1e3 * row['ms_per_robot']:.0f}", memory])
    return markdown_table(["robots", "ms", "µs per robot", "kB per robot"], rows)


def report(result: dict[str, Any]) -> str:
    """Return all tables of what was measured."""
    tables = {"points": sensors, "stages": stages, "robots": robots}
    texts = [table(result) for section, table in tables.items() if section in result]
    return "\n\n".join([*texts, verdicts(result)])
