"""Completion: predicted ground where the sensors could not see, with its standard deviation.

The network, its weights and the layers it makes are here; its training is in `training/completion`.
"""
