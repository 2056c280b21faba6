"""Observations for policies: height scans, map images, and estimates for unknown cells. Environments are in `gym`."""
