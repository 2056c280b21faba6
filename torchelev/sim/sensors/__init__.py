"""Sensors of many robots at once: rays cast at height fields and boxes, on any device.

Sensors for exact scenes, and the ray patterns of both, are in `torchelev.sim.exact.sensors`.
"""
