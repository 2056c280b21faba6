"""Scenes in closed form for one robot, with exact sensors, noise and trajectories, in float64 on the CPU.

Simulation of many robots, on any device, is in `torchelev.sim.terrains` and `torchelev.sim.sensors`.
"""
