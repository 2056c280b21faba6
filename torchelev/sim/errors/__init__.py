"""Errors of sensors and poses that each environment draws for itself, and presets of real sensors."""
