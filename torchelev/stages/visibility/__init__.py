"""Visibility clean-up and the upper bound: what rays say of the cells below them (paper, Sec. II-E, II-H)."""
