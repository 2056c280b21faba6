"""Process noise: certainty fades (paper, Sec. II-C)."""
