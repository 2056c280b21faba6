"""Measurements of speed and quality, one command each. All write to `benchmarks/results`; no test or training needs them."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"
