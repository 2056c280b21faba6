"""The window follows the robot, by whole cells (paper, Sec. II)."""
