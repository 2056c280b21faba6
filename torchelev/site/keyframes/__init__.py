"""Contributions of each merge with the poses of the robots: moved when a pose graph corrects the past."""
