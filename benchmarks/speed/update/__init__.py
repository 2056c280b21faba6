"""What `benchmarks.speed.run` measures of an update: sections, tables and plots. Loops and long runs: one level up."""
