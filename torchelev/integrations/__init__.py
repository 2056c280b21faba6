"""Observation terms for manager-based simulators: `mjlab` and `isaac_lab` read a map instead of the true terrain.

Import them by these names. Neither the package nor `torchelev` imports a simulator; other environments are in `gym`.
"""
