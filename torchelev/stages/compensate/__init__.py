"""Height drift compensation (paper, Sec. II-D)."""
