"""Completion: the ground that the sensors could not see, and how sure that is.

The network, its weights and the layers it makes are here; its training is in `training/completion`.
"""
