"""Parts of messages: times of points, calibration, depth images and their compressions, types of drivers.

`point_cloud` and `scans` put them together. Nothing here knows bags.
"""
