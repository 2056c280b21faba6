"""What speed benchmarks share: workloads, a bag to read, clocks and memory of processes, and verdicts on growth."""
