"""What stages by tensors share: sums by slot, minima, windows, moves; and what torch runs around them.

No equation of the paper lives here; stages import from here, never the other way.
"""
