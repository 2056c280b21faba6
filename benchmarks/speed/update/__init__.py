"""Sections, tables and plots of updates for `benchmarks.speed.run`. Loops and long runs are one level up."""
