"""What PyTorch and its compiler need: custom operators, stored values, masks, sums over windows.

No equation of the paper lives here; stages import from here, never the other way.
"""
