"""Inputs of an update: its arguments and their checks, point clouds, and environments in chunks.

How a check's error reads stands in `torchelev/errors.py`; what a height scan reads from outside, in `observations/`.
"""
