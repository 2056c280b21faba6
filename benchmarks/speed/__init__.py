"""Time and memory. Results are in `benchmarks/results`."""
