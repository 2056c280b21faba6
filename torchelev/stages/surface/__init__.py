"""Normals and the analytic rating, which share their windows (paper, Sec. II-A and II-G)."""
