"""Figures that experiments read from the logs of finished trainings, and their format over several seeds."""

from __future__ import annotations

from pathlib import Path


def read_scalars(folder: Path, tag: str) -> dict[int, float]:
    """Read a figure of each iteration from the TensorBoard log in a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    log.Reload()
    values = {point.step: point.value for point in log.Scalars(tag)}  # a resumed training repeats iterations
    return dict(sorted(values.items()))


def mean(values: list[float]) -> float:
    """Return the mean."""
    return sum(values) / len(values)


def spread(values: list[float]) -> str:
    """Return fractions as percentages: the mean, and the lowest and highest."""
    return f"{100 * mean(values):.1f} % ({100 * min(values):.1f} to {100 * max(values):.1f})"
