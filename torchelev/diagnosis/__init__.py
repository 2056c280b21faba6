"""Diagnosis: suspicious inputs of a map, their likely cause and a fix; and a warning when updates slow down.

The errors that refuse inputs outright are in `torchelev.inputs.update_inputs` and `torchelev.inputs.checks`.
"""
