"""The parts of `ElevationMap`: its buffers, what reads them, and what starts maps over. Updates are in its own file."""
