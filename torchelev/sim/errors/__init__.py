"""Errors of sensors and pose estimates that each environment draws for itself, and presets of real sensors.

Noise with the same settings for every cloud is in `torchelev.sim.exact.noise`.
"""
