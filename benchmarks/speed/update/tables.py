"""The tables of a speed result, and a verdict on each target."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from benchmarks.speed.common.workload import BPEARL, SENSORS
from torchelev.app.results import markdown_table

TARGETS = {6276: 2.0, 43074: 4.0, 407040: 16.0}  # [ms] one robot
_TENSORS = 12  # factor on TARGETS for updates by tensors
MANY = 28.0  # [ms] 256 robots
FLAT = 1.15  # largest growth of the time per robot beyond 256 robots
_MEMORY = 1.5  # factor on the minimum memory of map, points and polar table
_FRACTION = 0.15  # of an update's time: reset, recenter, sample
GROWTH = {"points": 1.0, "cells": 1.1, "rays": 0.1}  # largest exponents, the last in absolute value
IMPORT, FIRST_UPDATE, LATER_UPDATE = 0.15, 20, 0.3  # [s]
RESIDENT = 250  # [MB] of a process with a map of one robot


class Check(NamedTuple):
    """A measured value and its upper limit."""

    case: str
    value: float
    limit: float
    form: str  #: format of both
    remark: str = ""


def _index_by(rows: list[dict[str, Any]], key: str) -> dict[Any, dict[str, Any]]:
    """Index rows by one of their fields."""
    return {row[key]: row for row in rows}


def verdicts(result: dict[str, Any]) -> str:
    """Tabulate the targets of the sections that were measured, and whether each is met."""
    sections = {
        "points": _points,
        "robots": _robots,
        "cells": _cells,
        "rays": _rays,
        "parts": _parts,
        "start": _start,
    }
    rows = []
    for section, checks in sections.items():
        for check in checks(result[section]) if section in result else ():
            verdict = "met" if check.value <= check.limit else "missed"
            measured, target = check.form.format(check.value), check.form.format(check.limit)
            rows.append([check.case, measured + check.remark, f"<= {target}", verdict])
    return markdown_table(["case", "measured", "target", ""], rows)


def _points(values: dict[str, Any]) -> Iterator[Check]:
    full, eager = (_index_by(values[kind], "points") for kind in ("full", "eager"))
    for n, limit in TARGETS.items():
        yield Check(f"one robot, {n:,} points", full[n]["median"], limit, "{:.1f} ms")
    for n, row in eager.items():
        remark = f", {row['median'] / full[n]['median']:.1f} x compiled code"
        yield Check(f"by tensors, {n:,} points", row["median"], _TENSORS * TARGETS[n], "{:.1f} ms", remark)
    yield Check("growth with points", values["exponent_from_43074"], GROWTH["points"], "exponent {:.2f}")


def _robots(values: dict[str, Any]) -> Iterator[Check]:
    rows = _index_by(values["rows"], "robots")
    yield Check("256 robots x 512 points", rows[256]["median"], MANY, "{:.1f} ms")
    slowest = max(row["ms_per_robot"] for n, row in rows.items() if n > 256)
    yield Check("time per robot beyond 256", slowest / rows[256]["ms_per_robot"], FLAT, "{:.2f} x that at 256")
    largest = max(row["bytes_per_robot"] for row in rows.values())
    memory = largest / values["needed_bytes_per_robot"]
    yield Check("memory per robot, of any number", memory, _MEMORY, "{:.2f} x the need on paper")


def _cells(values: dict[str, Any]) -> Iterator[Check]:
    yield Check("growth with cells", values["exponent"], GROWTH["cells"], "exponent {:.2f}")


def _rays(values: dict[str, Any]) -> Iterator[Check]:
    yield Check("growth with ray length", abs(values["exponent"]), GROWTH["rays"], "exponent {:.2f}")


def _parts(values: dict[str, Any]) -> Iterator[Check]:
    for row in values["rows"]:
        for name, fraction in row["shares"].items():
            yield Check(f"{name}, robots: {row['robots']}", 100 * fraction, 100 * _FRACTION, "{:.0f} % of an update")


def _start(values: dict[str, Any]) -> Iterator[Check]:
    yield Check("import beyond torch", values["import_seconds"], IMPORT, "{:.2f} s")
    yield Check("first update, which builds the C++", values["first_update_seconds"], FIRST_UPDATE, "{:.0f} s")
    yield Check("first update of later processes", values["cached_first_update_seconds"], LATER_UPDATE, "{:.2f} s")
    yield Check("memory of such a process", values["cached_megabytes"], RESIDENT, "{:.0f} MB")


def sensors(result: dict[str, Any]) -> str:
    """Tabulate the update time and rate with the paper's sensors (paper, Table II)."""
    full, plain, eager = (_index_by(result["points"][kind], "points") for kind in ("full", "baseline", "eager"))
    rows = []
    for name, n, paper, _ in SENSORS:
        times = [f"{kind[n]['median']:.1f} ({kind[n]['min']:.1f})" for kind in (full, plain, eager)]
        rows.append([name, f"{n:,}", *times, f"{1e3 / full[n]['median']:.0f}", f"{paper}"])
    kinds = [f"{kind}, ms (fastest)" for kind in ("all stages", "plain baseline", "by tensors")]
    head = ["the paper's sensor", "points", *kinds, "Hz", "the paper's Hz, Xavier GPU"]
    return markdown_table(head, rows)


def stages(result: dict[str, Any]) -> str:
    """Tabulate the time of each stage (paper, Table I)."""
    times = result["stages"]["stages"]
    rows = [[name, f"{time['median']:.2f}", f"{time['min']:.2f}"] for name, time in times.items()]
    return markdown_table([f"stage alone, {BPEARL:,} points", "median ms", "min ms"], rows)


def threads(result: dict[str, Any]) -> str:
    """Tabulate the times on one thread and on two."""
    rows: list[list[str]] = []
    by_case: dict[str, list[dict[str, Any]]] = {}
    for row in result["threads"]["rows"]:
        by_case.setdefault(row["case"], []).append(row)
    for case, of_case in by_case.items():
        for row in of_case:
            times = [f"{row[key]:.1f}" for key in ("median", "p90", "p99", "min")]
            faster = f"{of_case[0]['median'] / row['median']:.2f}"
            rows.append([case, f"{row['threads']}", *times, faster, f"{100 * row['share_of_copy']:.0f}"])
    head = ["", "threads", "p50 ms", "p90 ms", "p99 ms", "min ms", "times as fast as one", "share of a copy [%]"]
    return markdown_table(head, rows)


def robots(result: dict[str, Any]) -> str:
    """Tabulate time and memory against the number of robots."""
    rows = []
    for row in result["robots"]["rows"]:
        memory = f"{row['bytes_per_robot'] / 1e3:.0f}"
        rows.append([f"{row['robots']:,}", f"{row['median']:.1f}", f"{1e3 * row['ms_per_robot']:.0f}", memory])
    return markdown_table(["robots", "ms", "µs per robot", "kB per robot"], rows)


def report(result: dict[str, Any]) -> str:
    """Return the tables of the sections that were measured."""
    tables = {"points": sensors, "threads": threads, "stages": stages, "robots": robots}
    texts = [table(result) for section, table in tables.items() if section in result]
    return "\n\n".join([*texts, verdicts(result)])
