"""Colours of all figures and pages, which colour-blind readers can tell apart."""

UNKNOWN_COLOR = "#d9d9d9"  #: cells without a value
HEIGHTS = "viridis"  #: colour map of heights [m]
DEVIATIONS = "magma"  #: colour map of standard deviations [m]
ERRORS = "PuOr_r"  #: colour map of signed differences: purple below, orange above
RATINGS = "cividis"  #: colour map of traversability, from 0 (dark, impassable) to 1 (light)
ROBOT_COLOR = "#d55e00"  #: robots, paths and cameras
GOAL_COLOR = "#e69f00"  #: goals
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  #: of lines (Okabe and Ito)
