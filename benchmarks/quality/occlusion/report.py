"""What the trials of the rules come to: shares by kind of ground, and their table."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from benchmarks.quality.occlusion.rules import PREDICTED, RULES
from benchmarks.quality.occlusion.scenes import KINDS, Case
from benchmarks.quality.occlusion.walks import VIEWS
from torchelev.app.results import markdown_table

Rates = dict[str, dict[str, Any]]  # [%] by rule and kind of ground


class Trial(NamedTuple):
    """What the rules decided on one walk."""

    case: Case
    goes: dict[str, list[bool]]  #: by rule, for each of VIEWS
    unknown: int  #: unknown cells close behind an edge, over all views
    close: dict[str, int]  #: how many of them each rule predicts well


def decisions(trials: list[Trial]) -> Rates:
    """Return how often each rule is right [%], by kind of ground and distance, and over whole walks.

    At one distance, a rule is right if it finds a path exactly where the ground is safe. Over a whole walk, it is right
    if it finds a path at every view of safe ground, and none at some view of a drop.
    """
    result: Rates = {}
    for rule in RULES:
        for kind, of_kind in _by_kind(trials).items():
            goes, safe = [trial.goes[rule] for trial in of_kind], of_kind[0].case.safe
            by_view = zip(VIEWS, zip(*goes, strict=True), strict=True)
            rates = {f"{view} m": _percent(g == safe for g in at) for view, at in by_view}
            whole = _percent(all(g) == safe for g in goes)
            result.setdefault(rule, {})[kind] = rates | {"all": _mean(rates.values()), "whole walk": whole}
    return result


def footholds(trials: list[Trial]) -> Rates:
    """Return how often each rule predicts a height within 3 cm [%], by kind of ground; of kinds, the mean."""
    result: Rates = {}
    for kind, of_kind in _by_kind(trials).items():
        unknown = sum(trial.unknown for trial in of_kind)
        for rule in PREDICTED if unknown else ():
            result.setdefault(rule, {})[kind] = round(100 * sum(trial.close[rule] for trial in of_kind) / unknown, 1)
    return {rule: kinds | {"all": _mean(kinds.values())} for rule, kinds in result.items()}


def _by_kind(trials: list[Trial]) -> dict[str, list[Trial]]:
    kinds: dict[str, list[Trial]] = {}
    for trial in trials:
        kinds.setdefault(trial.case.kind, []).append(trial)
    return kinds


def _percent(right: Iterable[bool]) -> float:
    return round(100 * _mean(right), 1)


def _mean(values: Iterable[float]) -> float:
    values = list(values)
    return round(sum(values) / len(values), 3)


def table(right: Rates, predicted: Rates) -> str:
    """Tabulate how often each rule is right, by kind of ground over all distances, and its footholds."""
    kinds = [make.__name__.replace("_", " ") for make in KINDS]
    rows = []
    for rule, of_rule in right.items():
        rates = [of_rule[kind]["all"] for kind in kinds]
        close = predicted.get(rule, {}).get("all")
        rows.append([rule, *(f"{r:.0f}" for r in (*rates, _mean(rates))), "" if close is None else f"{close:.0f}"])
    return markdown_table(["rule", *kinds, "mean", "footholds within 3 cm"], rows)
