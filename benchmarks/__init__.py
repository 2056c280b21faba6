"""Measurements of speed and quality, one command each, with their results in `benchmarks/results`."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"
