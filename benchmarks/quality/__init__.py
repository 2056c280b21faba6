"""Accuracy, features and behaviour against ground truth. Results are in `benchmarks/results`."""
