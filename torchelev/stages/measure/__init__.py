"""From a sensor's points to a measurement: transform, gates, noise (paper, Sec. II-A and II-C)."""
