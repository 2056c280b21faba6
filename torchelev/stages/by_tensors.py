"""Variants of stages that no compiled code computes."""


class ByTensors:
    """Settings of a variant that only tensors compute: they update maps with one, on every device."""
