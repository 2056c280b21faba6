"""Filters and plane segmentation beside the OpenCV and SciPy calls that give the same."""
