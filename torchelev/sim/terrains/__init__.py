"""Terrains for many robots: height fields, tiles of many kinds and difficulties, and an obstacle course.

Scenes in closed form for a single robot are in `torchelev.sim.exact`.
"""
