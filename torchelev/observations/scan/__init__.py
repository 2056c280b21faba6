"""How `HeightScan` works: its settings and presets, reading by tensors, and reading in C++."""
