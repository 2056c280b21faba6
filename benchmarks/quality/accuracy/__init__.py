"""The error of the map beside those of the per-cell mean and maximum of the same points."""
