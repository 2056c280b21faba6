"""Channels: what a map holds of each cell besides its height, such as colours, classes and features."""
