"""Overlap clearance: other floors than the robot's are no part of its map (paper, Sec. II-F)."""
