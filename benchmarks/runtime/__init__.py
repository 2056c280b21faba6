"""Measurements and proofs of the C library: `python -m benchmarks.runtime`."""
