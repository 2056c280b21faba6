"""Write the README's tables from the results, so that no number stands there without its run.

    python -m docs.readme_tables

Each table stands between <!-- name --> and <!-- end -->.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from benchmarks.speed import long_run as long_runs
from benchmarks.speed import tables as speed_tables
from torchelev.app.results import markdown_table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
SPEED = "speed-2-x-intel-r-xeon-r-processor-2-threads"
SHOWN = ("turn none", "turn noisy", "turn outliers", "walk noisy", "walk outliers", "lidar noisy", "lidar outliers")


def load(name: str) -> dict[str, Any]:
    """Read a result."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def accuracy() -> str:
    """Tabulate map / mean [mm] by scene, and count the cases that hold."""
    rows = load("accuracy")["rows"]
    cells = {(r["scene"], f"{r['motion']} {r['noise']}"): f"{r['rmse']:.1f} / {r['rmse_mean']:.1f}" for r in rows}
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    table = markdown_table(["scene", *SHOWN], [[scene, *(cells[scene, case] for case in SHOWN)] for scene in scenes])
    failed = [f"*{r['scene']} {r['motion']} {r['noise']}*" for r in rows if not r["holds"]]
    verdict = f"not {', '.join(failed)}" if failed else "all of them"
    return f"{table}\n\n{len(rows) - len(failed)} of {len(rows)} cases hold their bars: {verdict}."


def features() -> str:
    """Tabulate the figures that have a bar."""
    rows = [list(r.values()) for r in load("features")["rows"] if r["bar"]]
    return markdown_table(["feature", "figure", "on", "off", "baseline", "bar", ""], rows)


def changes() -> str:
    """Tabulate how soon changes show."""
    from benchmarks.quality import changes as new

    return new.tables(load("changes"))


def real() -> str:
    """Tabulate held-out errors on flat cells."""
    head = ["recording", "cell", "method", "median", "p90", "coverage", "ms / scan"]
    rows = []
    for r in load("real")["rows"]:
        errors = [f"{100 * r[name]:.1f} cm" for name in ("flat_median_m", "flat_p90_m")]
        time = f"{r['ms_per_scan']:.0f}" if r.get("ms_per_scan") else ""
        cell = f"{100 * r['resolution_m']:.0f} cm"
        rows.append([r["recording"], cell, r["method"], *errors, f"{100 * r['coverage']:.1f} %", time])
    return markdown_table(head, rows)


def speed() -> str:
    """Tabulate the sensors, the stages, the robots, and the targets."""
    picture = f"![Time against points, robots, cells and ray length](benchmarks/results/{SPEED}.png)"
    return f"{speed_tables.report(load(SPEED))}\n\n{picture}"


def loop() -> str:
    """Tabulate a 50 Hz loop, idle and beside a busy process."""
    from benchmarks.speed import loop as loops

    return loops.table(load("loop")["rows"])


def long_run() -> str:
    """Tabulate growth over long runs."""
    cases = {name: values for name, values in load("long_run").items() if name in long_runs.CASES}
    return long_runs.table(cases)


def nav() -> str:
    """Tabulate what policies reach, by what they were trained with."""
    from training.nav import experiment as nav_experiment

    return nav_experiment.table(json.loads((nav_experiment.RESULTS / "nav.json").read_text()))


def sight() -> str:
    """Tabulate what sight costs while a policy learns."""
    from benchmarks.speed import sight as costs

    return costs.table(load("sight")["rows"])


def postprocessing() -> str:
    """Tabulate filters and planes."""
    from benchmarks.speed import postprocessing as times

    result = load("postprocessing")
    return f"{times.table(result['rows'])}\n\n{times.planes_table(result['planes'])}"


def occlusion() -> str:
    """Tabulate who was right over whole walks [%], by rule and kind of ground."""
    right = load("occlusion")["right [%]"]
    kinds = list(next(iter(right.values())))
    rows = [[rule, *(f"{shares[kind]['whole walk']:.0f}" for kind in kinds)] for rule, shares in right.items()]
    return markdown_table(["rule for unknown ground", *kinds], rows)


def traversability() -> str:
    """Tabulate how good the heads are, on held-out ground and on a kind that was never trained on."""
    from training.traversability import evaluate as heads

    result = json.loads((ROOT / "training" / "results" / "traversability.json").read_text())
    names = {
        "held_out": "Kinds of ground that it trained on",
        "unseen": "Stepping stones, which it never saw",
        "held_out_exact": "Maps of the true heights, to at most 1 cm of white noise, of the kinds that it trained on",
    }
    return "\n\n".join(f"{name}:\n\n{heads.table(result, split)}" for split, name in names.items())


def head() -> str:
    """Tabulate what the heads cost."""
    from benchmarks.speed import head as costs

    return costs.table(load("head")["rows"])


def block() -> str:
    """Tabulate what the heads say beside a sharp step."""
    from training.traversability import block as steps

    return steps.table(json.loads((steps.RESULTS / "block.json").read_text())["profiles"])


TABLES = {
    "accuracy": accuracy,
    "features": features,
    "changes": changes,
    "real": real,
    "speed": speed,
    "loop": loop,
    "long_run": long_run,
    "nav": nav,
    "sight": sight,
    "postprocessing": postprocessing,
    "occlusion": occlusion,
    "traversability": traversability,
    "head": head,
    "block": block,
}


def with_tables(text: str) -> str:
    """Return the README with its tables made anew."""
    for name, table in TABLES.items():
        pattern = rf"(<!-- {name} -->\n).*?(<!-- end -->)"
        text, count = re.subn(pattern, lambda m, t=table: m[1] + t() + "\n" + m[2], text, flags=re.DOTALL)
        assert count == 1, f"README.md must hold <!-- {name} --> ... <!-- end --> once"
    return text


if __name__ == "__main__":
    readme = ROOT / "README.md"
    readme.write_text(with_tables(readme.read_text()))
