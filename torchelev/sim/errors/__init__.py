"""Errors of sensors and pose estimates, drawn for each environment, and presets of real sensors.

Noise with the same settings for every cloud is in `torchelev.sim.exact.noise`.
"""
