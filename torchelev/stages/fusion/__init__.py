"""The height update: the Kalman filter per cell, its outlier gate, edges and new obstacles (paper, Sec. II-C)."""
