"""How well a score of cells tells safe ground from unsafe: what is ranked, what is calibrated, what is inflated.

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

Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]

SAFE = 0.5  # of a label
RECALL = 0.95
BINS = 15
INFLATION_REACH = 0.5  # [m] from unsafe ground


class RatedMap(NamedTuple):
    """One map's scores and labels (H, W), and the cells that count."""

    score: Floats
    label: Floats
    rated: Bools
    resolution: float  # [m]


def pooled(maps: Iterable[RatedMap]) -> tuple[Floats, Floats]:
    """Return the scores and labels of all the cells that count, in a row each."""
    pairs = [(m.score[m.rated], m.label[m.rated]) for m in maps]
    return np.concatenate([score for score, _ in pairs]), np.concatenate([label for _, label in pairs])


def measure(maps: list[RatedMap]) -> dict[str, float | None]:
    """Return all metrics of maps, None where they have no value, as of ground that is all safe.

    Raises ValueError for scores or labels that are not within 0 to 1.
    """
    score, label = pooled(maps)
    for name, values in (("score", score), ("label", label)):
        within = bool(((values >= 0) & (values <= 1)).all())
        require(within, name, "must lie within 0 to 1", "other values", "give shares, without NaN")
    safe = label >= SAFE
    found = {
        "cells": float(len(score)),
        "safe_share": float(safe.mean()) if len(safe) else None,
        "iou": intersection_over_union(score >= SAFE, safe),
        "calibration_error": calibration_error(score, label),
    }
    if not len(safe) or safe.all() or not safe.any():
        return found | dict.fromkeys(RANKED)
    accept, reject = threshold_at_safe_recall(score[safe]), threshold_at_unsafe_recall(score[~safe])
    return found | {
        "average_precision": float(average_precision_score(safe, score)),
        "average_precision_unsafe": float(average_precision_score(~safe, -score)),
        "roc_auc": float(roc_auc_score(safe, score)),
        "false_safe": float((score[~safe] >= accept).mean()),
        "inflation_cm": inflation(maps, SAFE),
        "inflation_at_recall_cm": inflation(maps, reject),
    }


RANKED = (
    "average_precision",
    "average_precision_unsafe",
    "roc_auc",
    "false_safe",
    "inflation_cm",
    "inflation_at_recall_cm",
)


def intersection_over_union(found: Bools, safe: Bools) -> float | None:
    """Return the cells found and safe over those found or safe; None if there are none."""
    either = int((found | safe).sum())
    return float((found & safe).sum() / either) if either else None


def calibration_error(score: Floats, label: Floats, bins: int = BINS) -> float | None:
    """Return the expected calibration error: sum over bins of n / N |mean score - mean label| (Naeini et al. 2015).

    The bins divide 0 to 1 evenly. A label is the share of headings at which the robot stands, so a score of 0.8 is
    calibrated if it stands there at four of five headings.
    """
    if not len(score):
        return None
    number = np.minimum((score * bins).astype(int), bins - 1)
    gaps = np.bincount(number, score - label.astype(float), bins)
    return float(np.abs(gaps).sum() / len(score))


def threshold_at_safe_recall(score: Floats, recall: float = RECALL) -> float:
    """Return the highest threshold that keeps a share `recall` of safe cells at or above it."""
    return float(np.sort(score)[len(score) - math.ceil(recall * len(score) - 1e-9)])


def threshold_at_unsafe_recall(score: Floats, recall: float = RECALL) -> float:
    """Return the lowest threshold that leaves a share `recall` of unsafe cells below it."""
    highest_left = np.sort(score)[math.ceil(recall * len(score) - 1e-9) - 1]
    return float(np.nextafter(highest_left, highest_left.dtype.type(np.inf)))


def inflation(maps: Iterable[RatedMap], threshold: float) -> float | None:
    """Return by how far unsafe ground spreads beyond its true edge [cm], if scores below the threshold are unsafe.

    The area of falsely unsafe cells within 0.5 m of truly unsafe ones, over the length of the true edge between rated
    cells; None without an edge. Holes that lie farther from unsafe ground are false alarms, but no inflation.
    """
    parts = [(_spread(m, threshold), edge_length(m)) for m in maps]
    area, length = (sum(column) for column in zip(*parts, strict=True)) if parts else (0.0, 0.0)
    return 100 * area / length if length > 0 else None


def _spread(m: RatedMap, threshold: float) -> float:
    """Return the area [m^2] of falsely unsafe cells near unsafe ones."""
    unsafe = m.rated & (m.label < SAFE)
    if not unsafe.any():
        return 0.0
    near = distance_transform_edt(~unsafe) * m.resolution <= INFLATION_REACH
    false = m.rated & ~unsafe & (m.score < threshold) & near
    return float(false.sum()) * m.resolution**2


def edge_length(m: RatedMap) -> float:
    """Return the length [m] of the edge between safe and unsafe ground.

    pi / 4 times that of the cells' sides (Cauchy-Crofton): right on average over edges that lie anyhow to the cells,
    0.79 times the length along the cells' sides, 1.11 times along their diagonals.
    """
    sides = 0
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        sides += int((m.rated[a] & m.rated[b] & ((m.label[a] >= SAFE) != (m.label[b] >= SAFE))).sum())
    return math.pi / 4 * sides * m.resolution
