"""How well the scores of cells separate safe from unsafe ground: ranking, calibration and inflation of obstacles.

Scores and labels are from 0 to 1, the higher the safer; a cell is safe if its label is at least 0.5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from sklearn.metrics import average_precision_score, roc_auc_score

from torchelev.errors import require

_Floats = NDArray[np.floating]
_Bools = NDArray[np.bool_]

SAFE = 0.5  # lowest label and score of safe ground
_RECALL = 0.95
_BINS = 15
_INFLATION_REACH = 0.5  # [m] from unsafe ground


class RatedMap(NamedTuple):
    """The scores and labels of one map, (H, W) each."""

    score: _Floats
    label: _Floats
    rated: _Bools  #: cells that count
    resolution: float  #: [m]


def _pool(maps: Iterable[RatedMap]) -> tuple[_Floats, _Floats]:
    """Return the scores and labels (N,) of all cells that count."""
    pairs = [(m.score[m.rated], m.label[m.rated]) for m in maps]
    return np.concatenate([score for score, _ in pairs]), np.concatenate([label for _, label in pairs])


def measure(maps: list[RatedMap]) -> dict[str, float | None]:
    """Return all metrics of maps; None for those that are undefined, such as a ranking of ground that is all safe.

    Raises:
        ValueError: a score or label is not within 0 to 1.
    """
    score, label = _pool(maps)
    for name, values in (("score", score), ("label", label)):
        within = bool(((values >= 0) & (values <= 1)).all())
        require(within, name, "must lie within 0 to 1", "other values", "give fractions without NaN")
    safe = label >= SAFE
    found = {
        "cells": float(len(score)),
        "safe_share": float(safe.mean()) if len(safe) else None,
        "iou": intersection_over_union(score >= SAFE, safe),
        "calibration_error": calibration_error(score, label),
    }
    if not len(safe) or safe.all() or not safe.any():
        return found | dict.fromkeys(_RANKED)
    accept, reject = threshold_at_safe_recall(score[safe]), threshold_at_unsafe_recall(score[~safe])
    return found | {
        "average_precision": float(average_precision_score(safe, score)),
        "average_precision_unsafe": float(average_precision_score(~safe, -score)),
        "roc_auc": float(roc_auc_score(safe, score)),
        "false_safe": float((score[~safe] >= accept).mean()),
        "inflation_cm": inflation(maps, SAFE),
        "inflation_at_recall_cm": inflation(maps, reject),
    }


_RANKED = (
    "average_precision",
    "average_precision_unsafe",
    "roc_auc",
    "false_safe",
    "inflation_cm",
    "inflation_at_recall_cm",
)


def intersection_over_union(found: _Bools, safe: _Bools) -> float | None:
    """Return |found and safe| / |found or safe|; None if the union is empty."""
    either = int((found | safe).sum())
    return float((found & safe).sum() / either) if either else None


def calibration_error(score: _Floats, label: _Floats, bins: int = _BINS) -> float | None:
    """Return the expected calibration error: sum over bins of n / N |mean score - mean label| (Naeini et al. 2015).

    The bins divide 0 to 1 evenly. A label is the fraction of headings at which the robot can stand, so a score of 0.8
    is calibrated if the robot can stand there at four of five headings.
    """
    if not len(score):
        return None
    number = np.minimum((score * bins).astype(int), bins - 1)
    gaps = np.bincount(number, score - label.astype(float), bins)
    return float(np.abs(gaps).sum() / len(score))


def threshold_at_safe_recall(score: _Floats, recall: float = _RECALL) -> float:
    """Return the highest threshold at or above which a fraction `recall` of the safe cells lies."""
    return float(np.sort(score)[len(score) - math.ceil(recall * len(score) - 1e-9)])


def threshold_at_unsafe_recall(score: _Floats, recall: float = _RECALL) -> float:
    """Return the lowest threshold below which a fraction `recall` of the unsafe cells lies."""
    highest_left = np.sort(score)[math.ceil(recall * len(score) - 1e-9) - 1]
    return float(np.nextafter(highest_left, highest_left.dtype.type(np.inf)))


def inflation(maps: Iterable[RatedMap], threshold: float) -> float | None:
    """Return how far unsafe ground extends beyond its true edge [cm], if scores below the threshold are unsafe.

    It is the area of the falsely unsafe cells within 0.5 m of truly unsafe ones, divided by the length of the true edge
    between rated cells; None without an edge. Falsely unsafe cells farther away are false alarms, not inflation.
    """
    parts = [(_inflated_area(m, threshold), edge_length(m)) for m in maps]
    area, length = (sum(column) for column in zip(*parts, strict=True)) if parts else (0.0, 0.0)
    return 100 * area / length if length > 0 else None


def _inflated_area(m: RatedMap, threshold: float) -> float:
    """Return the area [m^2] of falsely unsafe cells near truly unsafe ones."""
    unsafe = m.rated & (m.label < SAFE)
    if not unsafe.any():
        return 0.0
    near = distance_transform_edt(~unsafe) * m.resolution <= _INFLATION_REACH
    false = m.rated & ~unsafe & (m.score < threshold) & near
    return float(false.sum()) * m.resolution**2


def edge_length(m: RatedMap) -> float:
    """Return the length [m] of the edge between safe and unsafe ground.

    It is pi / 4 times the length of the cells' sides on the edge (Cauchy-Crofton): correct on average over all
    directions, 0.79 times the true length along the cells' sides and 1.11 times along their diagonals.
    """
    sides = 0
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        sides += int((m.rated[a] & m.rated[b] & ((m.label[a] >= SAFE) != (m.label[b] >= SAFE))).sum())
    return math.pi / 4 * sides * m.resolution
