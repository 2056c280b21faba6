"""A peer is a file here, of NumPy and its own package alone: see `benchmarks.peers.peer`."""
