"""Training of policies and of the learned traversability head: one folder each, run from the checkout."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"
